"""Commands about captures and hands: `data ...` without imports, and `hands ...`."""

from __future__ import annotations

import argparse
import json
import shlex
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING

from hwp_bench.cli.options import (
    add_force,
    add_json,
    add_splits,
    add_suite_or_captures,
    print_json,
    splits_of,
)

if TYPE_CHECKING:
    from hwp_bench.capture.check import CheckReport
    from hwp_bench.capture.splits import AuditReport
    from hwp_bench.tracking import TrackedVideo

_CHECK = """examples:
  hwp-bench data check my_capture
  hwp-bench data check --json captures/*

Exit status 0: every capture is sound; 1: at least one is not.
"""


def add_check(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of `data check`."""
    parser.epilog = _CHECK
    parser.add_argument("captures", nargs="+", metavar="CAPTURE", help="capture folder")
    add_json(parser, "print the report as JSON")


def do_check(args: argparse.Namespace) -> int:
    """Run `data check`."""
    from hwp_bench.base.console import track
    from hwp_bench.capture.check import check_capture

    reports = [check_capture(path) for path in track(args.captures, "checking captures")]
    if args.json:
        print_json([{"ok": report.ok, **asdict(report)} for report in reports])
    else:
        for report in reports:
            _print_check(report)
    return 0 if all(report.ok for report in reports) else 1


def _print_check(report: CheckReport) -> None:
    from hwp_bench.base.errors import shown
    from hwp_bench.base.tables import Column, Table, print_table

    title = shown(report.path)
    verdict = "sound" if report.ok else "NOT SOUND"
    rows = tuple((name, _fact(value)) for name, value in report.facts.items())
    if rows:
        columns = (Column("fact"), Column("value"))
        print_table(Table(f"{title}: {verdict}", columns, rows))
    else:
        print(f"{title}: {verdict}")
    for finding in report.findings:
        parts = (finding.level, finding.where, finding.field, finding.problem)
        remedy = f" {finding.remedy}" if finding.remedy else ""
        said = ": ".join(part for part in parts if part)
        print(shown(f"{said}.{remedy}").replace("\n", " "))


def _fact(value: object) -> str:
    if value is None:
        return "unknown"
    if isinstance(value, dict):
        known = {key: "unknown" if item is None else item for key, item in value.items()}
        return ", ".join(f"{key} {item}" for key, item in known.items()) or "none"
    if isinstance(value, list):
        return ", ".join(str(item) for item in value) or "none"
    return str(value)


_SHOW = """examples:
  hwp-bench data show my_capture
  hwp-bench data show my_capture -o sheet.png --count 48 --edge 192

The sheet shows frames evenly over the capture: green the visible-hand mask, orange the right
and blue the left estimated hand; over each frame its number and the severity of what perturbs
it (hoi: interaction, cp: complex poses, il: illumination, mb: motion blur).
"""


def add_show(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of `data show`."""
    parser.epilog = _SHOW
    parser.add_argument("capture", metavar="CAPTURE", help="capture folder")
    parser.add_argument("-o", "--out", help="PNG to write (default: ID-sheet.png here)")
    parser.add_argument("--count", type=int, default=24, help="frames on the sheet (default 24)")
    parser.add_argument(
        "--edge", type=int, default=256, help="larger side of a frame, px (default 256)"
    )


def do_show(args: argparse.Namespace) -> int:
    """Run `data show`."""
    from hwp_bench.base.errors import UsageError
    from hwp_bench.base.files import check_places
    from hwp_bench.base.images import write_image
    from hwp_bench.capture import open_capture
    from hwp_bench.capture.check import contact_sheet

    if args.count < 1 or not 16 <= args.edge <= 2048:
        raise UsageError("at least one frame, of 16 to 2048 px, is drawn", field="--count, --edge")
    capture = open_capture(args.capture)
    out = Path(args.out or f"{capture.info.id}-sheet.png")
    check_places({"--out": out}, {"CAPTURE": args.capture})
    print(write_image(out, contact_sheet(capture, count=args.count, edge=args.edge)))
    return 0


_AUDIT = """examples:
  hwp-bench data audit my_capture
  hwp-bench data audit my_capture --guard 15
  hwp-bench data audit captures/* --splits splits/hwp-v1.json --json

Exit status 0: parts are disjoint and no test frame is known to be perturbed; 1: otherwise.
Near-copies across the border are reported and do not change the status.
"""


def add_audit(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of `data audit`."""
    parser.epilog = _AUDIT
    parser.add_argument("captures", nargs="+", metavar="CAPTURE", help="capture folder")
    add_splits(parser)
    parser.add_argument(
        "--guard", type=int, default=0, help="frames left out before each border (default 0)"
    )
    add_json(parser, "print the reports as JSON")


def do_audit(args: argparse.Namespace) -> int:
    """Run `data audit`."""
    from hwp_bench.base.console import track
    from hwp_bench.base.errors import UsageError
    from hwp_bench.capture import open_capture
    from hwp_bench.capture.splits import audit_split, contiguous_split, split_for

    if args.guard < 0 or (args.guard and args.splits):
        raise UsageError("a guard gap is at least 0, and not for a split file", field="--guard")
    splits = splits_of(args)
    reports = []
    for path in track(args.captures, "auditing splits"):
        capture = open_capture(path)
        if splits is None:
            split = contiguous_split(capture.info.id, len(capture), guard=args.guard)
        else:
            split = split_for(capture.info.id, len(capture), splits)
        reports.append(audit_split(capture, split))
    if args.json:
        print_json([{"ok": report.ok, **asdict(report)} for report in reports])
    else:
        for report in reports:
            _print_audit(report)
    return 0 if all(report.ok for report in reports) else 1


def _print_audit(report: AuditReport) -> None:
    from hwp_bench.base.tables import Column, Table, print_table

    closest = min(report.near_duplicates, key=lambda pair: pair[2], default=None)
    near = "none"
    if closest is not None:
        near = (
            f"{len(report.near_duplicates)}; the closest: test frame {closest[0]} and frame "
            f"{closest[1]}, RMS {closest[2]:.2f} levels; none with a guard gap of "
            f"{report.guard_needed} frames"
        )
    hashes = "none"
    if report.same_hashes:
        hashes = (
            f"{len(report.same_hashes)} pairs; none with a guard gap of "
            f"{report.guard_needed_by_hash} frames"
        )
    perturbed = ", ".join(f"{frame} ({name})" for frame, name in report.perturbed_test[:10])
    rows = (
        ("frames", ", ".join(f"{part} {count}" for part, count in report.counts.items())),
        ("in more than one part", str(list(report.overlap)) if report.overlap else "none"),
        ("in no part (guard gap)", str(len(report.left_out))),
        ("perturbed test frames", perturbed or "none known"),
        ("severity unknown for", ", ".join(report.unknown_severity) or "none"),
        ("near-copies across the border", near),
        ("one perceptual hash across the border", hashes),
    )
    verdict = "fair" if report.ok else "NOT FAIR"
    columns = (Column("question"), Column("answer"))
    print_table(Table(f"{report.capture}: {verdict}", columns, rows))


_GET = """examples:
  hwp-bench data get hwp
  hwp-bench data get hwp -o WildGHand --capture capture0_ capture1_
  hwp-bench data get hwp --revision 0123456789abcdef

Needs huggingface_hub: pip install 'hwp-bench[hub]'. Run the same command again to continue an
interrupted download. Checksums are pinned on first use; existing files are never replaced.
"""


def add_get(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of `data get`."""
    parser.description = "Download a public data set."
    parser.epilog = _GET
    parser.add_argument("name", choices=("hwp",), help="hwp: the official release")
    parser.add_argument(
        "-o", "--out", type=Path, default=Path("WildGHand"), metavar="DIR", help="folder to make"
    )
    parser.add_argument(
        "--capture",
        nargs="+",
        action="extend",
        default=[],
        metavar="NAME",
        help="only folders whose names begin with this",
    )
    parser.add_argument("--revision", help="branch, tag or commit (default: the newest)")
    add_json(parser, "print what was downloaded as JSON")


def do_get(args: argparse.Namespace) -> int:
    """Run `data get`."""
    from hwp_bench.base.console import JobsView, notice
    from hwp_bench.base.files import check_places
    from hwp_bench.importers.official.download import HuggingFaceHub, download_release

    check_places({"--out": args.out}, {})
    with JobsView() as jobs:
        update = jobs.turn(0, 1, f"downloading to {args.out}")
        made = download_release(
            args.out,
            HuggingFaceHub(),
            captures=args.capture,
            revision=args.revision,
            update=update,
        )
    for name in made.archives:
        notice(f"warning: {name} is an archive; it is left packed")
    if args.json:
        value = {
            "folder": str(made.folder),
            "commit": made.commit,
            "files": made.files,
            "kept": made.kept,
        }
        print_json(value)
        return 0
    print(f"folder: {made.folder}, {len(made.files)} files, {made.kept} of them existed before")
    print(f"commit: {made.commit}")
    return 0


_TRACK = """examples:
  hwp-bench data track hand.mp4
  hwp-bench data track hand.mp4 -o hand.npz --hands 1 --sheet hand.jpg
  hwp-bench data track hand.mp4 --model hand_landmarker.task
  hwp-bench data track --fetch

Needs ai-edge-litert: pip install 'hwp-bench[track]'. The networks are those of MediaPipe 0.10.21.
They are downloaded once (36 MB, of which 8 MB are kept). `hwp-bench data import-video` reads the
result; docs/video.md describes it.
"""


def add_track(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of `data track`."""
    parser.description = "Track the hands of a video."
    parser.epilog = _TRACK
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
    add_json(parser, "print the numbers as JSON")


def do_track(args: argparse.Namespace) -> int:
    """Run `data track`."""
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
        from hwp_bench.tracking.sheet import landmark_sheet

        write_image(args.sheet, landmark_sheet(tracked))
    if args.json:
        print_json({"landmarks": str(out), **tracked.facts()})
    else:
        _print_track(tracked, out)
    return 0


def _print_track(tracked: TrackedVideo, out: Path) -> None:
    facts = tracked.facts()
    frames = tracked.reading.counted()
    print(f"{out}: {frames} frames, {facts['frames_per_second']:.1f} frames per second")
    for hand in facts["hands"]:
        print(
            f"{hand['side']} hand: seen in {hand['frames_seen']} frames, {hand['tracks']} tracks, "
            f"score {hand['mean_score']:.3f}; votes: right {hand['right']:.2f}, "
            f"left {hand['left']:.2f}"
        )


_INPUTS = """examples:
  hwp-bench data inputs --suite mini -o inputs
  hwp-bench data inputs --capture my_capture -o inputs --name mine
  hwp-bench evaluate inputs/submission --suite mini      # once the predictions are there

For a program of your own that runs where and how it likes. inputs/requests/CAPTURE holds training
frames, masks, and the hand parameters and cameras of every frame; inputs/README.md says which
frames are to be drawn. The program writes them to inputs/submission/predictions/CAPTURE.
"""


def add_inputs(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of `data inputs`."""
    parser.epilog = _INPUTS
    add_suite_or_captures(parser)
    parser.add_argument("-o", "--out", type=Path, required=True, metavar="DIR", help="new folder")
    parser.add_argument(
        "--name", default="mine", help="short name of your method in tables (default mine)"
    )
    add_json(parser, "print what was written as JSON")


def do_inputs(args: argparse.Namespace) -> int:
    """Run `data inputs`."""
    from hwp_bench.base.files import check_places
    from hwp_bench.evaluation.evaluate import open_captures
    from hwp_bench.publish.inputs import check_place, write_inputs
    from hwp_bench.sim import ensure_suite

    # Before a suite is rendered.
    check_places({"--out": args.out}, {"--capture": args.capture, "--splits": args.splits})
    check_place(args.out, args.name)
    splits = splits_of(args)
    paths = [Path(path) for path in args.capture] if args.capture else ensure_suite(args.suite)
    data = ["--capture", *args.capture] if args.capture else ["--suite", args.suite]
    data += ["--splits", args.splits] if args.splits else []
    score = shlex.join(["hwp-bench", "evaluate", str(args.out / "submission"), *data])
    made = write_inputs(open_captures(paths, splits), args.out, name=args.name, score=score)
    if args.json:
        value = {
            "requests": str(made.requests),
            "submission": str(made.submission),
            "frames": dict(made.wanted),
            "score": score,
        }
        print_json(value)
        return 0
    print(f"to read: {made.requests} ({len(made.wanted)} captures)")
    print(f"to fill: {made.submission}/predictions ({sum(made.wanted.values())} frames)")
    print(f"then: {score}")
    return 0


_PUBLISH = """examples:
  hwp-bench data publish captures/* -o publication
  hwp-bench data publish captures/* -o publication --splits splits/mine.json
  hwp-bench evaluate submission/ --sealed publication/sealed

publication/public goes to authors: training and validation frames, and the hand parameters and
cameras of every frame. publication/sealed stays with the keeper: it holds the test frames, and the
salt of the commitment that the public manifest carries.
"""


def add_publish(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of `data publish`."""
    parser.description = "Divide captures into a public and a sealed part."
    parser.epilog = _PUBLISH
    parser.add_argument(
        "captures", nargs="+", type=Path, metavar="CAPTURES", help="capture folders"
    )
    parser.add_argument(
        "-o", "--out", type=Path, required=True, metavar="DIR", help="folder to make"
    )
    add_splits(parser)
    add_json(parser, "print what was written as JSON")


def do_publish(args: argparse.Namespace) -> int:
    """Run `data publish`."""
    from hwp_bench.base.files import check_places
    from hwp_bench.publish import publish

    check_places({"--out": args.out}, {"CAPTURES": args.captures, "--splits": args.splits})
    splits = splits_of(args)
    made = publish(args.captures, args.out, splits=splits)
    if args.json:
        value = {
            "public": str(made.public),
            "sealed": str(made.sealed),
            "commitment": made.commitment,
            "captures": list(made.captures),
        }
        print_json(value)
        return 0
    print(f"captures: {', '.join(made.captures)}")
    print(f"for authors: {made.public}")
    print(f"keep secret: {made.sealed}")
    print(f"commitment: {made.commitment}")
    return 0


_CONVERT = """examples:
  hwp-bench hands convert my_capture as_mano --hand-model mano:mano_v1_2/models
  hwp-bench hands convert mano_capture as_free --hand-model anny --json

Writes the capture again with its hands in another hand model, by fitting, and prints the errors
of the fit. True hand parameters are left out: they belong to the old model.
"""


def add_convert(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of `hands convert`."""
    parser.description = "Convert a capture's hands to another hand model."
    parser.epilog = _CONVERT
    parser.add_argument("capture", type=Path, metavar="CAPTURE", help="capture folder")
    parser.add_argument("out", type=Path, metavar="OUT", help="capture folder to make")
    parser.add_argument(
        "--hand-model", required=True, metavar="MODEL", help="anny, mano:PATH or mano-hd:PATH"
    )
    add_force(parser)
    add_json(parser, "print the errors as JSON")


def do_convert(args: argparse.Namespace) -> int:
    """Run `hands convert`."""
    from hwp_bench.base.files import check_places
    from hwp_bench.capture import open_capture
    from hwp_bench.capture.convert import convert_capture

    check_places(
        {"OUT": args.out}, {"CAPTURE": args.capture}, replaces=args.force, makes_captures=True
    )
    errors = convert_capture(
        open_capture(args.capture), args.out, args.hand_model, overwrite=args.force
    )
    if args.json:
        print_json({side: asdict(error) for side, error in errors.items()})
        return 0
    for side, error in errors.items():
        print(
            f"{side} hand: skin {error.skin_mm:.2f} mm (worst frame {error.worst_skin_mm:.2f}), "
            f"landmarks {error.landmark_mm:.2f} mm"
        )
    print(f"capture: {args.out}")
    return 0


_EXPORT = """examples:
  hwp-bench hands export my_capture hand.glb              # the estimated hands of frame 0
  hwp-bench hands export my_capture hand.obj --frame 12
  hwp-bench hands export simulated hand.ply --frame 12 --truth

The ending of the file says the format: .glb, .obj, .ply or .stl. Coordinates are in m, in the
world of the cameras.
"""


def add_export(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of `hands export`."""
    parser.description = "Write the posed hand meshes of one frame for other programs."
    parser.epilog = _EXPORT
    parser.add_argument("capture", type=Path, metavar="CAPTURE", help="capture folder")
    parser.add_argument("out", type=Path, metavar="FILE", help="mesh file to write")
    parser.add_argument("--frame", type=int, default=0, help="index of the frame (default 0)")
    parser.add_argument(
        "--truth", action="store_true", help="the true hands of a simulated capture"
    )


def do_export(args: argparse.Namespace) -> int:
    """Run `hands export`."""
    from hwp_bench.base.files import check_places
    from hwp_bench.capture import open_capture
    from hwp_bench.capture.convert import hand_meshes, write_meshes

    check_places({"FILE": args.out}, {"CAPTURE": args.capture})
    meshes = hand_meshes(open_capture(args.capture), args.frame, truth=args.truth)
    path = write_meshes(meshes, args.out)
    count = sum(len(mesh.vertices) for mesh in meshes.values())
    print(f"{path}: {' and '.join(meshes)} hand, {count} vertices")
    return 0


#: The arguments and the work of each command, where `main` looks for them.
COMMANDS = {
    "check": (add_check, do_check),
    "show": (add_show, do_show),
    "audit": (add_audit, do_audit),
    "get": (add_get, do_get),
    "track": (add_track, do_track),
    "inputs": (add_inputs, do_inputs),
    "publish": (add_publish, do_publish),
    "convert": (add_convert, do_convert),
    "export": (add_export, do_export),
}
