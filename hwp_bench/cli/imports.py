"""Commands that take other data in: `data import ...`."""

from __future__ import annotations

import argparse
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Any

from hwp_bench.base.console import notice
from hwp_bench.base.files import check_places
from hwp_bench.cli.options import (
    add_json,
    add_out,
    add_overwrite,
    add_splits,
    print_json,
    print_result,
    say_next,
    splits_of,
)

if TYPE_CHECKING:
    from hwp_bench.importers.video import ImportedClip

_VIDEO = """examples:
  hwp-bench data track hand.mp4
  hwp-bench data import video hand.mp4 --landmarks hand.npz -o my_capture
  hwp-bench data import video hand.mp4 --landmarks hand.npz -o my_capture --focal 1020 --side left
  hwp-bench data import video hand.mp4 --landmarks hand.npz -o part --range 100:400 --stride 2

LANDMARKS.npz comes from `hwp-bench data track` or another hand tracker and contains, for every
frame of the video, image (F, 21, 2 or 3) in pixels, world (F, 21, 3) in metres and score (F,) in
[0, 1]; score 0 means that no hand was seen. docs/video.md explains how to read the result.
"""


def _add_video(parser: argparse.ArgumentParser) -> None:
    parser.description = "Make a capture of a video of hands and the landmarks tracked in it."
    parser.epilog = _VIDEO
    add = parser.add_argument
    add("video", type=Path, metavar="VIDEO", help="video file")
    add_out(parser, "capture folder to make")
    landmarks = "tracked landmarks"
    add("--landmarks", type=Path, required=True, metavar="LANDMARKS.npz", help=landmarks)
    _add_side(parser, "one or both, as the landmarks and a fit to them show")
    focal = "focal length of the whole frame; else estimated"
    add("--focal", type=float, metavar="PX", help=focal)
    add("--masks", type=Path, metavar="DIR", help="your own masks, named by frame number")
    _add_size(parser)
    add("--range", metavar="A:B", help="only frames A to B-1")
    stride = "every K-th frame (default: 1)"
    add("--stride", type=int, default=1, metavar="K", help=stride)
    score = "below this score a frame counts as without a hand (default: 0.5)"
    add("--min-score", type=float, default=0.5, metavar="S", help=score)
    add("--hand-model", default="anny", metavar="MODEL", help="anny (default) or mano:PATH")
    add("--sheet", type=Path, metavar="PNG", help="write the overlay sheet here too")
    add("--id", metavar="ID", help="capture id (default: the folder's name)")
    add("--action", default="unknown", metavar="TEXT", help="what the hand does")
    add("--device", default="unknown", metavar="TEXT", help="what recorded it")
    add("--licence", default="unknown", metavar="TEXT", help="terms of use")
    names = "perturbations in the clip, comma separated; their severities stay unknown"
    add("--perturbations", default="", metavar="NAMES", help=names)
    add_overwrite(parser, "an existing capture")
    add_json(parser, "print the numbers as JSON")


def _add_side(parser: argparse.ArgumentParser, auto: str) -> None:
    sides, text = ("auto", "right", "left", "both"), f"which hands (default: auto, {auto})"
    parser.add_argument("--side", choices=sides, default="auto", help=text)


def _add_size(parser: argparse.ArgumentParser) -> None:
    text = "edge of the frames (default: 256)"
    parser.add_argument("--size", type=int, default=256, metavar="PX", help=text)


def _video(args: argparse.Namespace) -> int:
    from hwp_bench.importers.video import (
        VideoImport,
        import_video,
        parse_frame_range,
        read_finished_import,
    )

    inputs = {"VIDEO": args.video, "--landmarks": args.landmarks, "--masks": args.masks}
    outputs = {"--out": args.out, "--sheet": args.sheet}
    check_places(outputs, inputs, replaces=args.overwrite, makes_captures=True)
    given = ("side", "focal", "masks", "size", "id", "action", "device", "licence", "hand_model")
    options = VideoImport(
        **{name: getattr(args, name) for name in (*given, "min_score", "sheet")},
        frames=parse_frame_range(args.range, args.stride),
        perturbations=tuple(name for name in args.perturbations.split(",") if name),
        overwrite=args.overwrite,
    )
    finished = read_finished_import(args.video, args.landmarks, args.out, options)
    if finished is not None:
        notice(f"{args.out} is complete: the same call has made it; --overwrite imports again")
        return print_result(args.json, finished, [f"capture: {args.out}"])
    clip = import_video(args.video, args.landmarks, args.out, options)
    if args.json:
        print_json(clip.facts())
    else:
        _print_video(clip, args)
    say_next("hwp-bench", "data", "check", args.out)
    say_next("wildghand", "fit", args.out, "-o", f"{args.out}_avatar")
    return 0


def _print_video(clip: ImportedClip, args: argparse.Namespace) -> None:
    import numpy as np

    from hwp_bench.importers.shared.output import SHEET_NAME

    facts = clip.facts()
    video = clip.source.video
    detected = " and ".join(
        f"{side} hand detected in {hand.landmarks.detected.sum()}, fitted in "
        f"{hand.parameters.valid.sum()}"
        for side, hand in clip.hands.items()
    )
    print(f"capture: {args.out}, {facts['frames']} frames, {detected}")
    if len(clip.hands) == 2:
        print(f"exchanged by the tracker and put right: {facts['swaps_repaired']} times")
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


_WILDGHAND = """examples:
  hwp-bench data import wildghand WildGHand/capture0_subsample3_single -o captures/capture0
  hwp-bench data import wildghand WildGHand -o captures --mano mano_v1_2/models
  hwp-bench data import wildghand WildGHand -o compat --mano mano_v1_2/models --official-compat

DIR is one folder of the release (with output.pkl), or a folder of them; then OUT gets one capture
for each, and the same command continues an import that was interrupted. Pickles are read without
running code from them. Without --mano the free hand is fitted, and its error is printed in mm.
docs/data.md describes every step from the download to a table.
"""


def _add_out_and_mano(parser: argparse.ArgumentParser) -> None:
    add, text = parser.add_argument, "your MANO files; without them the free hand is fitted"
    add_out(parser, "capture folder to make")
    add("--mano", type=Path, metavar="MANO_DIR", help=text)


def _check_release_places(args: argparse.Namespace) -> None:
    inputs = {"DIR": args.folder, "--mano": args.mano}
    check_places({"--out": args.out}, inputs, replaces=args.overwrite, makes_captures=True)


def _add_wildghand(parser: argparse.ArgumentParser) -> None:
    parser.description = "Make captures of the official HWP release."
    parser.epilog = _WILDGHAND
    add = parser.add_argument
    add("folder", type=Path, metavar="DIR", help="folder of the release")
    _add_out_and_mano(parser)
    compat = "crop, intrinsics and translations as in the released loader"
    add("--official-compat", action="store_true", help=compat)
    add("--side", choices=("right", "left"), help="the hand of a single-hand capture")
    add("--id", metavar="ID", help="capture id (default: by the folder's name)")
    _add_size(parser)
    fps = "frame rate of the video before subsampling (default: 30)"
    add("--fps", type=float, default=30.0, help=fps)
    add_overwrite(parser, "an existing capture")
    add_json(parser, "print the facts as JSON")


def _wildghand(args: argparse.Namespace) -> int:
    from hwp_bench.importers.official import OfficialImport, import_official
    from hwp_bench.importers.official.from_release import check_import, read_finished_import
    from hwp_bench.importers.official.records import find_folders

    _check_release_places(args)
    options = OfficialImport(
        mano=args.mano,
        official_compat=args.official_compat,
        hand=args.side,
        size=args.size,
        video_fps=args.fps,
        overwrite=args.overwrite,
    )
    folders = find_folders(args.folder, args.id)
    several = folders[0].path != args.folder
    outs = [args.out / folder.id if several else args.out for folder in folders]
    done = [read_finished_import(*each, options) for each in zip(folders, outs, strict=True)]
    for folder, out, facts in zip(folders, outs, done, strict=True):
        if facts is None:
            check_import(folder, out, options)
        else:
            notice(f"{out} is complete: the same call has made it; --overwrite imports again")
    results = []
    for folder, out, finished in zip(folders, outs, done, strict=True):
        facts = finished or import_official(folder, out, options)
        for warning in facts["warnings"]:
            notice(f"warning: {folder.path}: {warning}")
        results.append({"out": str(out), **facts})
    say_next("hwp-bench", "data", "check", *(facts["out"] for facts in results))
    return print_result(args.json, results, [line for r in results for line in _official_lines(r)])


def _official_lines(facts: dict[str, Any]) -> list[str]:
    valid = ", ".join(f"{side} in {count}" for side, count in facts["frames_valid"].items())
    errors = [
        f"{side} hand ({facts['hand_model']}): {error:.2f} mm from the tracker's vertices, "
        f"joints {facts['joint_error_px'][side]:.2f} px from its joints, "
        f"{100 * facts['vertices_on_mask'][side]:.0f} % of its vertices on the mask"
        for side, error in facts["vertex_error_mm"].items()
    ]
    first = f"capture: {facts['out']}, {facts['frames']} frames, hands: {valid}"
    return [first, *errors, f"look at: {facts['out']}/extra/overlay.png"]


_INTERHAND26M = """examples:
  hwp-bench data import interhand26m InterHand2.6M touchrom-15 -o captures/touchrom-15
  hwp-bench data import interhand26m InterHand2.6M handscratch-16 -o scratch --mano mano_v1_2/models
  hwp-bench data import interhand26m InterHand2.6M Capture0/ROM01_No_Interaction/cam400262 -o x

DIR holds images/ and annotations/. The paper's three sequences have the names touchrom-15,
touchrom-16 and handscratch-16. The data set may not be used commercially (CC BY-NC 4.0).
"""


def _add_interhand26m(parser: argparse.ArgumentParser) -> None:
    parser.description = "Make a capture of a sequence of InterHand2.6M."
    parser.epilog = _INTERHAND26M
    add = parser.add_argument
    add("folder", type=Path, metavar="DIR", help="folder of the data set")
    add("sequence", metavar="SEQUENCE", help="a name, or CaptureN/SEQUENCE/camID")
    _add_out_and_mano(parser)
    _add_size(parser)
    fps = "frame rate of the annotated frames, 5 or 30 (default: 5)"
    add("--fps", type=float, default=5.0, help=fps)
    _add_side(parser, "those that the sequence is listed with")
    add_overwrite(parser, "an existing capture")
    add_json(parser, "print the facts as JSON")


def _interhand26m(args: argparse.Namespace) -> int:
    from hwp_bench.importers.interhand import InterHandImport, find_sequence, import_interhand

    _check_release_places(args)
    options = InterHandImport(
        mano=args.mano, size=args.size, fps=args.fps, side=args.side, overwrite=args.overwrite
    )
    facts = import_interhand(args.folder, find_sequence(args.sequence), args.out, options)
    lines = [f"capture: {args.out}, {facts['frames']} frames of {facts['split']}"]
    for side, error in facts["errors"].items():
        joints = "unknown" if error["joints_mm"] is None else f"{error['joints_mm']:.2f} mm"
        seen = f"in {error['frames_valid']} frames"
        lines.append(f"{side} hand: {seen}, joints {joints} from the annotated")
    lines.append(f"look at: {args.out}/extra/overlay.png")
    say_next("hwp-bench", "data", "check", args.out)
    return print_result(args.json, {"out": str(args.out), **facts}, lines)


_RENDERED = """examples:
  hwp-bench data import rendered EXPERIMENTS/c0_single --capture captures/capture0 -o authors
  hwp-bench data import rendered EXPERIMENTS/c4_multi --capture captures/capture4 -o authors
  hwp-bench evaluate authors --capture captures/capture0 captures/capture4 -o runs/authors

DIR is what the authors' code wrote with --run_val: the folder of an experiment, or one in it that
holds frame649_view649_pred_31.2_lr1.png and so on. OUT becomes a method directory of predictions,
to which further captures are added. The capture is to be imported with --official-compat, so that
its frames are cropped as theirs. docs/data.md says what is assumed.
"""


def _add_rendered(parser: argparse.ArgumentParser) -> None:
    parser.description = "Make predictions of frames that the authors' code has drawn."
    parser.epilog = _RENDERED
    add = parser.add_argument
    add("folder", type=Path, metavar="DIR", help="folder of an experiment of theirs")
    text = "the capture that they were drawn for"
    add("--capture", type=Path, required=True, metavar="CAPTURE", help=text)
    add_out(parser, "method directory to fill")
    name = "short name of the method in tables (default: authors-code)"
    add("--name", default="authors-code", help=name)
    add_splits(parser)
    add_overwrite(parser, "the predictions of that capture")
    add_json(parser, "print the facts as JSON")


def _rendered(args: argparse.Namespace) -> int:
    from hwp_bench.capture import open_capture
    from hwp_bench.capture.splits import split_for
    from hwp_bench.importers.official.rendered import import_rendered
    from hwp_bench.methods.template import check_name

    inputs = {"DIR": args.folder, "--capture": args.capture, "--splits": args.splits}
    check_places({"--out": args.out}, inputs)
    check_name(args.name, "--name")
    capture = open_capture(args.capture)
    split = split_for(capture.info.id, capture.info.frame_count, splits_of(args))
    more = {"name": args.name, "overwrite": args.overwrite}
    made = import_rendered(args.folder, capture, split, args.out, **more)
    for warning in made.warnings():
        notice(f"warning: {warning}")
    wanted = len(made.taken) + len(made.missing) + len(made.refused)
    lines = [
        f"predictions: {args.out}, {len(made.taken)} of {wanted} test frames of {made.capture}"
    ]
    if made.truth_db is not None:
        lines.append(f"their ground truth: {made.truth_db:.1f} dB from the capture's frames")
    lines.append(f"score them: hwp-bench evaluate {args.out} --capture {args.capture}")
    facts = {"out": str(args.out), **asdict(made), "warnings": made.warnings()}
    return print_result(args.json, facts, lines)


_SECOND_VIEW = """examples:
  hwp-bench data import second-view front side --calibration cameras.toml   # of two videos
  hwp-bench data import second-view cam400015 cam400016                     # of a data set

What the second camera saw at the same time becomes the free-view clip of CAPTURE, whose scores are
apart. docs/video.md describes the calibration file.
"""


def _add_second_view(parser: argparse.ArgumentParser) -> None:
    parser.epilog = _SECOND_VIEW
    add = parser.add_argument
    add("capture", type=Path, metavar="CAPTURE", help="capture folder, which gets the clip")
    add("second", type=Path, metavar="SECOND", help="capture of the second camera")
    text = "where both cameras are; needed for videos"
    add("--calibration", type=Path, metavar="TOML", help=text)
    add_overwrite(parser, "an existing clip")
    add_json(parser, "print the numbers as JSON")


def _second_view(args: argparse.Namespace) -> int:
    from hwp_bench.capture import open_capture
    from hwp_bench.importers.second_view import add_second_view, read_calibration

    calibration = None if args.calibration is None else read_calibration(args.calibration)
    captures = open_capture(args.capture), open_capture(args.second)
    made = add_second_view(*captures, calibration, overwrite=args.overwrite)
    place = args.capture / "free"
    lines = [f"free-view clip: {place}, {len(made.frames)} frames"]
    if made.scale is not None:
        lines.append(f"scale: a metre of the capture is {made.scale:.3f} m")
    lines.append(f"landmarks: {made.distance_px:.2f} px from where the second camera saw them")
    return print_result(args.json, {"clip": str(place), **asdict(made)}, lines)


#: The arguments and the work of each command, where `main` looks for them.
COMMANDS = {
    "video": (_add_video, _video),
    "wildghand": (_add_wildghand, _wildghand),
    "interhand26m": (_add_interhand26m, _interhand26m),
    "rendered": (_add_rendered, _rendered),
    "second-view": (_add_second_view, _second_view),
}
