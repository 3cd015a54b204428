"""Commands about captures: `data ...` but for imports, and `dev card`."""

from __future__ import annotations

import argparse
import shlex
from collections.abc import Iterable, Mapping
from dataclasses import asdict, replace
from pathlib import Path
from typing import TYPE_CHECKING

from hwp_bench.base.console import JobsView, notice, track
from hwp_bench.base.errors import BadSplit, UsageError, shown
from hwp_bench.base.files import check_is_file, check_places, refuse_existing_file
from hwp_bench.base.tables import print_table
from hwp_bench.cli.options import (
    SEVERAL,
    add_json,
    add_out,
    add_overwrite,
    add_splits,
    add_suite_or_captures,
    named_table,
    print_json,
    print_result,
    say_next,
    splits_of,
)
from hwp_bench.taxonomy import REAL_SUITES, SUITES

if TYPE_CHECKING:
    from hwp_bench.capture import Capture
    from hwp_bench.capture.check import CheckReport, Finding
    from hwp_bench.capture.splits import AuditReport, Split

_CHECK = """examples:
  hwp-bench data check my_capture
  hwp-bench data check --json captures/*
  hwp-bench data check captures/* --splits splits/hwp-v1.json
  hwp-bench data check my_capture --guard 15

Checks the files of a capture, and that its split is fair: parts that are disjoint, and no test
frame that is known to be perturbed. Exit status 0: so it is with every capture; 1: with at least
one it is not. Near-copies across a border of the split do not change the status.
"""


def _add_check(parser: argparse.ArgumentParser) -> None:
    parser.epilog = _CHECK
    parser.add_argument("captures", nargs="+", metavar="CAPTURE", help="capture folder")
    add_splits(parser)
    guard = "frames left out before each border of the split (default 0)"
    parser.add_argument("--guard", type=int, default=0, help=guard)
    add_json(parser, "print the reports as JSON")


def _check(args: argparse.Namespace) -> int:
    from hwp_bench.capture.check import Finding, check_capture
    from hwp_bench.capture.splits import audit_split

    if args.guard < 0 or (args.guard and args.splits):
        raise UsageError("a guard gap is at least 0, and not for a split file", field="--guard")
    splits, rows, sound = splits_of(args), [], True
    for path in track(args.captures, "checking captures"):
        report = check_capture(path)
        audit = None
        # Frames that cannot be read cannot be compared.
        if report.ok:
            try:
                capture, split = _capture_and_split(path, splits, args.guard)
                audit, found = audit_split(capture, split), _unscorable(capture, split)
            except BadSplit as error:
                found = [Finding("error", path, error.field, error.problem, error.remedy)]
            report = replace(report, findings=(*found, *report.findings))
        sound = sound and report.ok and (audit is None or audit.ok)
        if args.json:
            fair = None if audit is None else {"ok": audit.ok, **asdict(audit)}
            rows.append({"ok": report.ok, **asdict(report), "split": fair})
            continue
        _print_check(report)
        if audit is not None:
            _print_audit(audit)
    if args.json:
        print_json(rows)
    if sound:
        say_next("hwp-bench", "evaluate", "plain", "--capture", *args.captures)
    return 0 if sound else 1


def _print_check(report: CheckReport) -> None:
    # A line of its own: a caption is folded, and people copy the path and look for the verdict.
    print(f"{shown(report.path)}: {'sound' if report.ok else 'NOT SOUND'}")
    if report.facts:
        rows = [(name, _fact(value)) for name, value in report.facts.items()]
        print_table(named_table("", "fact, value", rows))
    print_findings(report.findings)


def print_findings(findings: Iterable[Finding]) -> None:
    """Print what is wrong, a line each."""
    for finding in findings:
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
  hwp-bench data show my_capture -o sheet.png --frame-count 48 --edge 192

The sheet shows frames evenly over the capture: green the visible-hand mask, orange the right
and blue the left estimated hand; over each frame its number and the severity of what perturbs
it (hoi: interaction, cp: complex poses, il: illumination, mb: motion blur).
"""


def _add_show(parser: argparse.ArgumentParser) -> None:
    parser.epilog = _SHOW
    add = parser.add_argument
    add("capture", metavar="CAPTURE", help="capture folder")
    add("-o", "--out", help="PNG to write (default: ID-sheet.png here)")
    add("--frame-count", type=int, default=24, metavar="N", help="frames on it (default 24)")
    add("--edge", type=int, default=256, help="larger side of a frame, px (default 256)")
    add_overwrite(parser, "a file that exists")


def _show(args: argparse.Namespace) -> int:
    from hwp_bench.base.images import write_image
    from hwp_bench.capture import open_capture
    from hwp_bench.capture.check import contact_sheet

    count = args.frame_count
    if count < 1 or not 16 <= args.edge <= 2048:
        text = "at least one frame, of 16 to 2048 px, is drawn"
        raise UsageError(text, field="--frame-count, --edge")
    capture = open_capture(args.capture)
    out = Path(args.out or f"{capture.info.id}-sheet.png")
    check_places({"--out": out}, {"CAPTURE": args.capture})
    refuse_existing_file(out, overwrite=args.overwrite, field="--out")
    print(write_image(out, contact_sheet(capture, count=count, edge=args.edge)))
    return 0


def _capture_and_split(
    path: str, splits: Mapping[str, Split] | None, guard: int
) -> tuple[Capture, Split]:
    from hwp_bench.capture import open_capture
    from hwp_bench.capture.splits import contiguous_split, split_for

    capture = open_capture(path)
    if splits is None:
        return capture, contiguous_split(capture.info.id, len(capture), guard=guard)
    return capture, split_for(capture.info.id, len(capture), splits)


def _unscorable(capture: Capture, split: Split) -> list[Finding]:
    """The frames that a test scores and whose mask leaves nothing to score."""
    from hwp_bench.capture.check import Finding
    from hwp_bench.metrics.pixels import unscorable

    clip, found = capture.free_view, []
    scored: list[tuple[Capture, Iterable[int], str]] = [(capture, split.test, "test")]
    if clip is not None:
        scored.append((clip, range(len(clip)), "free-view"))
    for part, frames, name in scored:
        for frame in unscorable(frames, part.scoring_mask):
            problem = f"the mask of {name} frame {frame} leaves no pixel to score"
            remedy = "These frames must show the hand."
            found.append(Finding("error", str(part.root), "masks", problem, remedy))
    return found


def _print_audit(report: AuditReport) -> None:
    near = hashes = "none"
    if report.near_duplicates:
        test, other, apart = min(report.near_duplicates, key=lambda pair: pair[2])
        near = (
            f"{len(report.near_duplicates)}; the closest: test frame {test} and frame {other}, "
            f"RMS {apart:.2f} levels; {_gap(report.guard_needed)}"
        )
    if report.same_hashes:
        hashes = f"{len(report.same_hashes)} pairs; {_gap(report.guard_needed_by_hash)}"
    perturbed = ", ".join(f"{frame} ({name})" for frame, name in report.perturbed_test[:10])
    rows = (
        ("frames", ", ".join(f"{part} {count}" for part, count in report.counts.items())),
        ("in no part (guard gap)", str(len(report.left_out))),
        ("perturbed test frames", perturbed or "none known"),
        ("severity unknown for", ", ".join(report.unknown_severity) or "none"),
        ("near-copies across the border", near),
        ("one perceptual hash across the border", hashes),
    )
    verdict = "fair" if report.ok else "NOT FAIR"
    print_table(named_table(f"{report.capture}: {verdict}", "question, answer", rows))


def _gap(frames: int | None) -> str:
    return "no gap removes them" if frames is None else f"none with a guard gap of {frames} frames"


_GET = """examples:
  hwp-bench data get real-1
  hwp-bench data get real-1 --from my_videos
  hwp-bench data get hwp
  hwp-bench data get hwp -o WildGHand --capture capture0_ capture1_
  hwp-bench data get hwp --revision 0123456789abcdef

hwp needs huggingface_hub: pip install 'hwp-bench[hub]'. Run the same command again to continue an
interrupted download. Checksums are pinned on first use; existing files are never replaced.

real-1 needs the tracker: pip install 'hwp-bench[track]'. Its clips are downloaded, checked by their
SHA-256, tracked and imported into the cache. Exit status 1: a clip is not available.
"""


def _add_get(parser: argparse.ArgumentParser) -> None:
    parser.description = "Download a public data set."
    parser.epilog = _GET
    add = parser.add_argument
    text = "hwp: the official release; real-1: a suite of real clips"
    add("name", choices=("hwp", *REAL_SUITES), help=text)
    text = "hwp: folder to make (default: WildGHand)"
    add("-o", "--out", type=Path, metavar="DIR", help=text)
    text = "hwp: only folders whose names begin with this"
    add("--capture", **SEVERAL, metavar="NAME", help=text)
    add("--revision", help="hwp: branch, tag or commit (default: the newest)")
    text = "real-1: take the videos from this folder, by their content, not from the network"
    add("--from", dest="source", type=Path, metavar="FOLDER", help=text)
    add_json(parser, "print what was downloaded as JSON")


def _get(args: argparse.Namespace) -> int:
    from hwp_bench.importers.official.download import HuggingFaceHub, download_release

    clips = args.name in REAL_SUITES
    of_hwp = {"--out": args.out, "--capture": args.capture, "--revision": args.revision}
    for option, given in (of_hwp if clips else {"--from": args.source}).items():
        if given:
            remedy = "Leave it out; `hwp-bench data get --help` says which data each option is for."
            raise UsageError(f"is not for {args.name}", field=option, remedy=remedy)
    if clips:
        return _get_clips(args)
    out = args.out or Path("WildGHand")
    check_places({"--out": out}, {})
    with JobsView() as jobs:
        made = download_release(
            out,
            HuggingFaceHub(),
            captures=args.capture,
            revision=args.revision,
            update=jobs.turn(0, 1, f"downloading to {out}"),
        )
    for name in made.archives:
        notice(f"warning: {name} is an archive; it is left packed")
    folder, files = str(made.folder), made.files
    value = {"folder": folder, "commit": made.commit, "files": files, "kept": made.kept}
    lines = (
        f"folder: {folder}, {len(files)} files, {made.kept} of them existed before",
        f"commit: {made.commit}",
    )
    say_next("hwp-bench", "data", "import", "wildghand", folder, "-o", "captures")
    return print_result(args.json, value, lines)


def _get_clips(args: argparse.Namespace) -> int:
    from hwp_bench.suites.real import ensure_clips

    folders, missing = ensure_clips(args.name, args.source)
    lines = [f"capture: {folder}" for folder in folders]
    lines += [f"missing: {clip}" for clip in missing]
    value = {"captures": [str(folder) for folder in folders], "missing": dict(missing)}
    print_result(args.json, value, lines)
    say_next("hwp-bench", "evaluate", "plain", "--suite", args.name)
    return int(bool(missing))


_TRACK = """examples:
  hwp-bench data track hand.mp4
  hwp-bench data track hand.mp4 -o hand.npz --hands 1 --sheet hand.jpg
  hwp-bench data track hand.mp4 --model hand_landmarker.task
  hwp-bench data track --fetch

Needs ai-edge-litert: pip install 'hwp-bench[track]'. The networks are those of MediaPipe 0.10.21.
They are downloaded once (36 MB, of which 8 MB are kept). `hwp-bench data import video` reads the
result; docs/video.md describes it.
"""


def _add_track(parser: argparse.ArgumentParser) -> None:
    parser.description = "Track the hands of a video."
    parser.epilog = _TRACK
    add = parser.add_argument
    add("video", type=Path, nargs="?", metavar="VIDEO", help="video file, not mirrored")
    out = "file to write (default: VIDEO.npz)"
    add("-o", "--out", type=Path, metavar="NPZ", help=out)
    hands = "most hands in a frame (default: 2)"
    add("--hands", type=int, choices=(1, 2), default=2, help=hands)
    least = "palms and hands of a lower score are left out (default: 0.5)"
    add("--min-score", type=float, default=0.5, metavar="S", help=least)
    model = "networks: a hand_landmarker.task, a wheel of MediaPipe 0.10.21, or a folder"
    add("--model", type=Path, metavar="FILE", help=model)
    add("--sheet", type=Path, metavar="IMAGE", help="draw a contact sheet")
    add("--fetch", action="store_true", help="download the networks and say where they are")
    add_overwrite(parser, "an existing file")
    add_json(parser, "print the numbers as JSON")


def _track(args: argparse.Namespace) -> int:
    from hwp_bench.importers.video.api import check_sheet
    from hwp_bench.tracking import TrackerSettings, fetch_models, track_video

    if args.fetch:
        folder = fetch_models()
        return print_result(args.json, {"models": str(folder)}, [f"networks: {folder}"])
    if args.video is None:
        raise UsageError("VIDEO is missing", remedy="Give a video, or --fetch.")
    least = args.min_score
    if not 0 < least < 1:
        remedy = "Use a number between 0 and 1."
        raise UsageError(f"is {least}", field="--min-score", remedy=remedy)
    check_is_file(args.video, field="VIDEO")
    out = args.out or args.video.with_suffix(".npz")
    outputs = {"--out": out, "--sheet": args.sheet}
    check_places(outputs, {"VIDEO": args.video, "--model": args.model})
    if args.sheet is not None:
        check_sheet(args.sheet)
    tracked = track_video(
        args.video,
        out,
        settings=TrackerSettings(args.hands, min_palm_score=least, min_presence=least),
        model=args.model,
        overwrite=args.overwrite,
        unseen=args.sheet,
    )
    if args.sheet is not None:
        from hwp_bench.base.images import write_image
        from hwp_bench.tracking.track_video import landmark_sheet

        write_image(
            args.sheet, landmark_sheet(tracked.video, tracked.reading.frames, tracked.hands)
        )
    facts = tracked.facts()
    frames = tracked.reading.counted()
    lines = [f"{out}: {frames} frames, {facts['frames_per_second']:.1f} frames per second"]
    lines += [
        f"{hand['side']} hand: seen in {hand['frames_seen']} frames, {hand['tracks']} tracks, "
        f"score {hand['mean_score']:.3f}; votes: right {hand['right']:.2f}, left {hand['left']:.2f}"
        for hand in facts["hands"]
    ]
    words = ("hwp-bench", "data", "import", "video", args.video, "--landmarks", out, "-o")
    say_next(*words, args.video.with_suffix(""))
    return print_result(args.json, {"landmarks": str(out), **facts}, lines)


_INPUTS = """examples:
  hwp-bench data inputs --suite mini -o inputs
  hwp-bench data inputs --capture my_capture -o inputs --name mine
  hwp-bench evaluate inputs/submission --suite mini      # once the predictions are there

For a program of your own that runs where and how it likes. inputs/requests/CAPTURE holds training
frames, masks, and the hand parameters and cameras of every frame; inputs/README.md says which
frames are to be drawn. The program writes them to inputs/submission/predictions/CAPTURE.
"""


def _add_inputs(parser: argparse.ArgumentParser) -> None:
    parser.epilog = _INPUTS
    add_suite_or_captures(parser)
    add_out(parser, "new folder")
    name = "short name of your method in tables (default mine)"
    parser.add_argument("--name", default="mine", help=name)
    add_json(parser, "print what was written as JSON")


def _inputs(args: argparse.Namespace) -> int:
    from hwp_bench.commitments.inputs import check_place, write_inputs
    from hwp_bench.commitments.publication import open_captures
    from hwp_bench.suites.suite import ensure_suite

    # Before a suite is rendered.
    check_places({"--out": args.out}, {"--capture": args.capture, "--splits": args.splits})
    check_place(args.out, args.name)
    splits = splits_of(args)
    paths = [Path(path) for path in args.capture] if args.capture else ensure_suite(args.suite)
    data = ["--capture", *args.capture] if args.capture else ["--suite", args.suite]
    data += ["--splits", args.splits] if args.splits else []
    score = shlex.join(["hwp-bench", "evaluate", str(args.out / "submission"), *data])
    made = write_inputs(open_captures(paths, splits), args.out, name=args.name, score=score)
    value = {
        "requests": str(made.requests),
        "submission": str(made.submission),
        "frames": dict(made.wanted),
        "score": score,
    }
    lines = (
        f"to read: {made.requests} ({len(made.wanted)} captures)",
        f"to fill: {made.submission}/predictions ({sum(made.wanted.values())} frames)",
        f"then: {score}",
    )
    return print_result(args.json, value, lines)


_CARD = """examples:
  hwp-bench dev card mini > mini.json

Croissant 1.0 (JSON-LD): captures with hands, perturbations, frames, split and digests, licence, and
for real clips the addresses of the videos with their SHA-256. Nothing is rendered or downloaded.
"""


def _add_card(parser: argparse.ArgumentParser) -> None:
    parser.epilog = _CARD
    parser.add_argument("suite", choices=SUITES, metavar="SUITE", help="name of a suite")


def _card(args: argparse.Namespace) -> int:
    from hwp_bench.leaderboard.data_card import data_card

    print_json(data_card(args.suite))
    return 0


_CONVERT = """examples:
  hwp-bench data convert my_capture -o as_mano --hand-model mano:mano_v1_2/models
  hwp-bench data convert mano_capture -o as_free --hand-model anny --json

Writes the capture again with its hands in another hand model, by fitting, and prints the errors
of the fit. A free-view clip in it is converted too, with the shape of the capture's hands. True
hand parameters are left out: they belong to the old model.
"""


def _add_convert(parser: argparse.ArgumentParser) -> None:
    parser.description = "Convert a capture's hands to another hand model."
    parser.epilog = _CONVERT
    add = parser.add_argument
    add("capture", type=Path, metavar="CAPTURE", help="capture folder")
    add_out(parser, "capture folder to make")
    add("--hand-model", required=True, metavar="MODEL", help="anny, mano:PATH or mano-hd:PATH")
    add_overwrite(parser, "an existing capture")
    add_json(parser, "print the errors as JSON")


def _convert(args: argparse.Namespace) -> int:
    from hwp_bench.capture import open_capture
    from hwp_bench.capture.convert import convert_capture

    inputs = {"CAPTURE": args.capture}
    check_places({"--out": args.out}, inputs, replaces=args.overwrite, makes_captures=True)
    capture = open_capture(args.capture)
    errors = convert_capture(capture, args.out, args.hand_model, overwrite=args.overwrite)
    lines = [
        f"{side} hand: skin {error.skin_mm:.2f} mm (worst frame {error.worst_skin_mm:.2f}), "
        f"landmarks {error.landmark_mm:.2f} mm"
        for side, error in errors.items()
    ]
    value = {side: asdict(error) for side, error in errors.items()}
    return print_result(args.json, value, [*lines, f"capture: {args.out}"])


_EXPORT = """examples:
  hwp-bench data export my_capture -o hand.glb              # the estimated hands of frame 0
  hwp-bench data export my_capture -o hand.obj --frame 12
  hwp-bench data export simulated -o hand.ply --frame 12 --truth

The ending of the file says the format: .glb, .obj, .ply or .stl. Coordinates are in m, in the
world of the cameras.
"""


def _add_export(parser: argparse.ArgumentParser) -> None:
    parser.description = "Write the posed hand meshes of one frame for other programs."
    parser.epilog = _EXPORT
    add = parser.add_argument
    add("capture", type=Path, metavar="CAPTURE", help="capture folder")
    add_out(parser, "mesh file to write", "FILE")
    add("--frame", type=int, default=0, help="index of the frame (default 0)")
    add("--truth", action="store_true", help="the true hands of a simulated capture")
    add_overwrite(parser, "a file that exists")


def _export(args: argparse.Namespace) -> int:
    from hwp_bench.capture import open_capture
    from hwp_bench.capture.convert import hand_meshes, write_meshes

    check_places({"--out": args.out}, {"CAPTURE": args.capture})
    meshes = hand_meshes(open_capture(args.capture), args.frame, truth=args.truth)
    refuse_existing_file(args.out, overwrite=args.overwrite, field="--out")
    path = write_meshes(meshes, args.out)
    count = sum(len(mesh.vertices) for mesh in meshes.values())
    print(f"{path}: {' and '.join(meshes)} hand, {count} vertices")
    return 0


#: The arguments and the work of each command, where `main` looks for them.
COMMANDS = {
    "check": (_add_check, _check),
    "show": (_add_show, _show),
    "get": (_add_get, _get),
    "track": (_add_track, _track),
    "inputs": (_add_inputs, _inputs),
    "card": (_add_card, _card),
    "convert": (_add_convert, _convert),
    "export": (_add_export, _export),
}
