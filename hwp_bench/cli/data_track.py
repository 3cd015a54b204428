"""`hwp-bench data track`."""

from __future__ import annotations

import argparse
import json
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from hwp_bench.tracking import TrackedVideo

_EXAMPLES = """examples:
  hwp-bench data track hand.mp4
  hwp-bench data track hand.mp4 -o hand.npz --hands 1 --sheet hand.jpg
  hwp-bench data track hand.mp4 --model hand_landmarker.task
  hwp-bench data track --fetch

Needs ai-edge-litert: pip install 'hwp-bench[track]'. The networks are those of MediaPipe 0.10.21.
They are downloaded once (36 MB, of which 8 MB are kept). `hwp-bench data import-video` reads the
result; docs/video.md describes it.
"""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of the command."""
    parser.description = "Track the hands of a video."
    parser.epilog = _EXAMPLES
    parser.add_argument("video", type=Path, nargs="?", metavar="VIDEO", help="not mirrored")
    parser.add_argument(
        "-o", "--out", type=Path, metavar="NPZ", help="file to write (default: VIDEO.npz)"
    )
    parser.add_argument(
        "--hands", type=int, choices=(1, 2), default=2, help="most hands in a frame (default: 2)"
    )
    parser.add_argument(
        "--min-confidence",
        type=float,
        default=0.5,
        metavar="P",
        help="palms and hands below this are left out (default: 0.5)",
    )
    parser.add_argument(
        "--model",
        type=Path,
        metavar="FILE",
        help="networks: a hand_landmarker.task, a wheel of MediaPipe 0.10.21, or a folder",
    )
    parser.add_argument("--sheet", type=Path, metavar="IMAGE", help="draw a contact sheet")
    parser.add_argument(
        "--fetch", action="store_true", help="download the networks and say where they are"
    )
    parser.add_argument("--force", action="store_true", help="replace an existing file")
    parser.add_argument("--json", action="store_true", help="print the numbers as JSON")


def run(args: argparse.Namespace) -> int:
    """Run the command."""
    from hwp_bench.base.errors import UsageError
    from hwp_bench.base.files import check_places
    from hwp_bench.tracking import TrackerSettings, fetch_models, track_video

    if args.fetch:
        folder = fetch_models()
        print(json.dumps({"models": str(folder)}) if args.json else f"networks: {folder}")
        return 0
    if args.video is None:
        raise UsageError("VIDEO is missing", remedy="Give a video, or --fetch.")
    out = args.out or args.video.with_suffix(".npz")
    check_places(
        {"--out": out, "--sheet": args.sheet}, {"VIDEO": args.video, "--model": args.model}
    )
    least = args.min_confidence
    tracked = track_video(
        args.video,
        out,
        settings=TrackerSettings(args.hands, min_palm_score=least, min_presence=least),
        model=args.model,
        overwrite=args.force,
    )
    if args.sheet is not None:
        from hwp_bench.base.images import write_image
        from hwp_bench.tracking.track_video import landmark_sheet

        write_image(args.sheet, landmark_sheet(tracked))
    if args.json:
        print(json.dumps({"landmarks": str(out), **tracked.facts()}, indent=1))
    else:
        _print(tracked, out)
    return 0


def _print(tracked: TrackedVideo, out: Path) -> None:
    facts = tracked.facts()
    frames = tracked.reading.counted()
    print(f"{out}: {frames} frames, {facts['frames_per_second']:.1f} frames per second")
    for hand in facts["hands"]:
        print(
            f"{hand['side']} hand: seen in {hand['frames_seen']} frames, {hand['tracks']} tracks, "
            f"score {hand['mean_score']:.3f}; votes: right {hand['right']:.2f}, "
            f"left {hand['left']:.2f}"
        )
