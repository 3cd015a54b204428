"""`hwp-bench data import-video`."""

from __future__ import annotations

import argparse
import json
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from hwp_bench.importers.video import ImportedClip

_EXAMPLES = """examples:
  hwp-bench data track hand.mp4
  hwp-bench data import-video hand.mp4 --landmarks hand.npz my_capture
  hwp-bench data import-video hand.mp4 --landmarks hand.npz my_capture --focal 1020 --side left
  hwp-bench data import-video hand.mp4 --landmarks hand.npz part --frames 100:400 --stride 2

LANDMARKS.npz comes from `hwp-bench data track` or another hand tracker and contains, for every
frame of the video, image (F, 21, 2 or 3) in pixels, world (F, 21, 3) in metres and score (F,) in
[0, 1]; score 0 means that no hand was seen. docs/video.md explains how to read the result.
"""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of the command."""
    parser.description = "Make a capture of a video of hands and the landmarks tracked in it."
    parser.epilog = _EXAMPLES
    parser.add_argument("video", type=Path, metavar="VIDEO", help="video file")
    parser.add_argument("out", type=Path, metavar="OUT", help="capture folder to make")
    parser.add_argument(
        "--landmarks", type=Path, required=True, metavar="LANDMARKS.npz", help="tracked landmarks"
    )
    parser.add_argument(
        "--side",
        choices=("auto", "right", "left", "both"),
        default="auto",
        help="which hands (default: auto, one or both, as the landmarks and a fit to them show)",
    )
    # The name of the option until it took two hands.
    parser.add_argument(
        "--hand",
        dest="side",
        choices=("right", "left"),
        default=argparse.SUPPRESS,
        help=argparse.SUPPRESS,
    )
    parser.add_argument(
        "--focal", type=float, metavar="PX", help="focal length of the whole frame; else estimated"
    )
    parser.add_argument(
        "--masks", type=Path, metavar="DIR", help="your own masks, named by frame number"
    )
    parser.add_argument(
        "--size", type=int, default=256, metavar="PX", help="edge of the frames (default: 256)"
    )
    parser.add_argument("--frames", metavar="A:B", help="only frames A to B-1")
    parser.add_argument(
        "--stride", type=int, default=1, metavar="K", help="every K-th frame (default: 1)"
    )
    parser.add_argument(
        "--min-score",
        type=float,
        default=0.5,
        metavar="S",
        help="below this score a frame counts as without a hand (default: 0.5)",
    )
    parser.add_argument(
        "--hand-model", default="anny", metavar="MODEL", help="anny (default) or mano:PATH"
    )
    parser.add_argument(
        "--sheet", type=Path, metavar="PNG", help="write the overlay sheet here too"
    )
    parser.add_argument("--id", metavar="ID", help="capture id (default: the folder's name)")
    parser.add_argument("--action", default="unknown", metavar="TEXT", help="what the hand does")
    parser.add_argument("--device", default="unknown", metavar="TEXT", help="what recorded it")
    parser.add_argument("--licence", default="unknown", metavar="TEXT", help="terms of use")
    parser.add_argument(
        "--perturbations",
        default="",
        metavar="NAMES",
        help="perturbations in the clip, comma separated; their severities stay unknown",
    )
    parser.add_argument("--force", action="store_true", help="replace an existing capture")
    parser.add_argument("--json", action="store_true", help="print the numbers as JSON")


def run(args: argparse.Namespace) -> int:
    """Run the command."""
    from hwp_bench.base.console import notice
    from hwp_bench.base.files import check_places
    from hwp_bench.importers.video import (
        VideoImport,
        finished_import,
        import_video,
        parse_frame_range,
    )

    inputs = {"VIDEO": args.video, "--landmarks": args.landmarks, "--masks": args.masks}
    outputs = {"OUT": args.out, "--sheet": args.sheet}
    check_places(outputs, inputs, replaces=args.force, makes_captures=True)
    options = VideoImport(
        side=args.side,
        focal=args.focal,
        masks=args.masks,
        size=args.size,
        frames=parse_frame_range(args.frames, args.stride),
        id=args.id,
        action=args.action,
        device=args.device,
        licence=args.licence,
        perturbations=tuple(name for name in args.perturbations.split(",") if name),
        hand_model=args.hand_model,
        min_score=args.min_score,
        sheet=args.sheet,
        overwrite=args.force,
    )
    finished = finished_import(args.video, args.landmarks, args.out, options)
    if finished is not None:
        notice(f"{args.out} is complete: the same call has made it; --force imports again")
        print(json.dumps(finished, indent=1) if args.json else f"capture: {args.out}")
        return 0
    clip = import_video(args.video, args.landmarks, args.out, options)
    if args.json:
        print(json.dumps(clip.facts(), indent=1))
    else:
        _print(clip, args)
    return 0


def _print(clip: ImportedClip, args: argparse.Namespace) -> None:
    import numpy as np

    from hwp_bench.importers.shared.writing import SHEET_NAME

    facts = clip.facts()
    video = clip.source.video
    detected = " and ".join(
        f"{side} hand detected in {hand.landmarks.detected.sum()}, fitted in "
        f"{hand.parameters.valid.sum()}"
        for side, hand in clip.hands.items()
    )
    print(f"capture: {args.out}, {facts['frames']} frames, {detected}")
    if len(clip.hands) == 2:
        print(f"exchanged by the tracker and put right: {clip.source.swaps} times")
    for side, hand in clip.hands.items():
        error, before = hand.error, hand.error_landmarks_only
        print(
            f"mean reprojection error of the 21 joints of the {side} hand: {error.mean:.2f} px at "
            f"{video.width}x{video.height} (median {error.median:.2f}, 95th percentile "
            f"{error.percentile_95:.2f}, worst joint {error.worst_landmark} "
            f"{error.worst_landmark_mean:.2f}; without the tracker's constant offsets "
            f"{error.without_offsets:.2f}; before the outline fit {before.mean:.2f})"
        )
    print(
        f"overlap of mesh and mask: {facts['overlap']:.3f} "
        f"(5th percentile {facts['overlap_percentile_5']:.3f}; "
        f"before the outline fit {facts['overlap_landmarks_only']:.3f})"
    )
    origin = "given" if args.focal is not None else "estimated"
    depths = np.concatenate([hand.parameters.transl[:, 2] for hand in clip.hands.values()])
    near, far = np.percentile(depths, (0, 100))
    print(f"focal length: {clip.focal:.0f} px ({origin}); at {near:.2f} to {far:.2f} m")
    print(f"crop: {clip.source.windows.side} px squares, stored at {args.size} px")
    sheet = args.sheet or args.out / "extra" / SHEET_NAME
    print(f"look at: {sheet}")
