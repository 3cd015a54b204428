"""Commands that look into a fit or the method: `judge`, `explain`, `network`, `completion`."""

from __future__ import annotations

import argparse
import dataclasses
from pathlib import Path
from typing import TYPE_CHECKING

from hwp_bench.base.files import check_places, refuse_existing_file
from hwp_bench.cli.options import add_json, print_json
from hwp_bench.cli.program import complete
from wildghand.cli.options import add_avatar, add_ending, avatar_of

if TYPE_CHECKING:
    import numpy as np

    from hwp_bench.capture import Capture
    from wildghand.prepass import FrameAssessment


_JUDGE_EXAMPLES = """examples:
  wildghand judge my_capture
  wildghand judge my_capture -o judgement.json --picture judgement.png

Estimates for every frame the probability that it is clean, and the severity (0-5) of each
perturbation that the capture lists, or of all four if it lists none. Whether a frame is perturbed
is much more certain than which perturbation it is; docs/studies/prepass.md has the numbers. The
capture is not changed.
"""


def _add_judge(parser: argparse.ArgumentParser) -> None:
    parser.epilog = _JUDGE_EXAMPLES
    add = parser.add_argument
    add("capture", type=Path, help="capture folder")
    add("-o", "--out", type=Path, metavar="FILE", help="JSON file to write")
    add("--picture", type=Path, metavar="FILE", help="PNG file to write: the estimates over time")
    add_ending(parser, "file")


def _do_judge(args: argparse.Namespace) -> int:
    import numpy as np

    from hwp_bench.base.console import track
    from hwp_bench.base.files import write_json
    from hwp_bench.capture import open_capture
    from wildghand.prepass import capture_input, estimated_severity, judge_frames

    outputs = {"--out": args.out, "--picture": args.picture}
    check_places(outputs, {"CAPTURE": args.capture})
    for option, path in outputs.items():
        if path is not None:
            refuse_existing_file(path, overwrite=args.overwrite, field=option)
    capture = open_capture(args.capture)
    every = np.arange(len(capture))
    assessment = judge_frames(capture_input(capture, every, track(every.tolist(), "Reading")))
    levels = estimated_severity(assessment)
    listed = capture.info.perturbations or levels
    levels = {kind: level for kind, level in levels.items() if kind in listed}
    record = {
        "capture": capture.info.id,
        "estimated": True,
        "clean": [round(value, 4) for value in assessment.clean.tolist()],
        "usable": assessment.usable.tolist(),
        "severity": {kind: level.tolist() for kind, level in levels.items()},
    }
    if args.out is not None:
        write_json(args.out, record)
    if args.picture is not None:
        _draw_judged(assessment, levels, args.picture)
    if args.json:
        print_json(record)
    else:
        _print_judged(capture, assessment, levels)
    return 0


def _print_judged(
    capture: Capture, assessment: FrameAssessment, levels: dict[str, np.ndarray]
) -> None:
    from hwp_bench.base.tables import Column, Table, print_table

    count = len(assessment)
    rows: list[tuple[str, int, float | None]] = [
        ("judged clean", int((assessment.clean >= 0.5).sum()), None),
        ("judged perturbed", int((assessment.usable & (assessment.clean < 0.5)).sum()), None),
        ("cannot be judged", count - int(assessment.usable.sum()), None),
    ]
    for kind, level in levels.items():
        acting = level[level > 0]
        mean = float(acting.mean()) if len(acting) else None
        rows.append((kind.replace("_", " "), len(acting), mean))
    columns = (Column("estimate"), Column("frames"), Column("mean level", 1))
    print_table(Table(f"{capture.info.id}, {count} frames", columns, tuple(rows), ranked=False))


def _draw_judged(assessment: FrameAssessment, levels: dict[str, np.ndarray], path: Path) -> None:
    import io

    from matplotlib.figure import Figure

    from hwp_bench.base.files import atomic_write

    figure = Figure(figsize=(9.0, 3.6), layout="constrained")
    clean, severity = figure.subplots(2, 1, sharex=True)
    clean.plot(assessment.indices, assessment.clean, color="black")
    clean.set(ylabel="probability clean", ylim=(-0.05, 1.05))
    for kind, level in levels.items():
        severity.step(assessment.indices, level, where="mid", label=kind.replace("_", " "))
    severity.set(ylabel="estimated severity", xlabel="frame", ylim=(-0.2, 5.2))
    severity.legend(fontsize=7, loc="center left", bbox_to_anchor=(1.0, 0.5))
    memory = io.BytesIO()
    figure.savefig(memory, format="png", dpi=110)
    atomic_write(path, memory.getvalue())


_EXPLAIN_EXAMPLES = """examples:
  wildghand explain my_avatar my_capture -o explained.png
  wildghand explain my_avatar my_capture --frames 3 17 40 -o explained.png

Shows what the biases took out of training frames: the frame, the hand without biases (what the
avatar is), the hand with the frame's biases, and the difference of the two. Without --frames the
eight frames of largest temporal weight are shown. The capture is the one that was fitted. Printed
are the mean size of omega, and its rank correlation with the severity of the perturbations, where
the capture says it: DPD disentangles what it should where the correlation is high.
"""


def _add_explain(parser: argparse.ArgumentParser) -> None:
    parser.epilog = _EXPLAIN_EXAMPLES
    add = parser.add_argument
    add_avatar(parser)
    add("capture", type=Path, help="capture folder that it was fitted to")
    add("-o", "--out", type=Path, required=True, metavar="FILE", help="PNG file")
    text = "frames of the capture"
    add("--frames", type=int, nargs="+", action="extend", metavar="N", help=text)
    add_ending(parser, "file")


def _do_explain(args: argparse.Namespace) -> int:
    from hwp_bench.base.images import write_image
    from hwp_bench.capture import open_capture
    from wildghand.avatar.render import explain_frames, explanation_sheet, temporal_weights
    from wildghand.prepass import frames_text

    check_places({"--out": args.out}, {"AVATAR": args.avatar, "CAPTURE": args.capture})
    refuse_existing_file(args.out, overwrite=args.overwrite, field="--out")
    capture = open_capture(args.capture)
    avatar = avatar_of(args)
    found = explain_frames(avatar, capture, args.frames)
    names = {}
    for item in found:
        acting = [kind for kind, level in capture.info.severity(item.frame).items() if level]
        names[item.frame] = ", ".join(kind.replace("_", " ") for kind in acting)
    write_image(args.out, explanation_sheet(found, names))
    weights = temporal_weights(avatar, capture)
    if args.json:
        hands = {
            side: {"mean_omega": size, "rank_with_severity": rank}
            for side, (size, rank) in weights.items()
        }
        frames = {item.frame: item.omega for item in found}
        print_json({"file": str(args.out), "frames": frames, "hands": hands})
        return 0
    record = avatar.record
    if record.clean and record.frame_weights:
        floor = avatar.settings.prepass.weight_floor
        print(frames_text(record.clean, record.frame_weights, floor))
    for side, (size, rank) in weights.items():
        told = "not known" if rank is None else f"{rank:.2f}"
        print(f"{side} hand: mean |omega| {size:.2g}, rank correlation with severity {told}")
    print(f"{args.out}: {len(found)} frames")
    return 0


_NETWORK_EXAMPLES = """examples:
  wildghand network compact
  wildghand network paper --json

Lists the layers and parameters of the prediction network for two hands.
"""


def _add_network(parser: argparse.ArgumentParser) -> None:
    parser.epilog = _NETWORK_EXAMPLES
    parser.add_argument("size", choices=("compact", "paper"), help="size of the network")
    add_json(parser)


def _do_network(args: argparse.Namespace) -> int:
    from hwp_bench.base.tables import Column, Table, print_table
    from wildghand.network.network import parameter_table, small_network
    from wildghand.network.settings import network_settings

    settings = network_settings(args.size)
    rows = parameter_table(small_network(settings))
    parts: dict[str, int] = {}
    for row in rows:
        parts[row.part] = parts.get(row.part, 0) + row.parameters
    total = sum(parts.values())
    if args.json:
        layers = [
            {**dataclasses.asdict(row), "part": row.part, "parameters": row.parameters}
            for row in rows
        ]
        facts = {"settings": settings.to_json(), "layers": layers, "parts": parts, "total": total}
        print_json(facts)
        return 0
    columns = tuple(map(Column, ("layer", "weights", "each", "times", "parameters")))
    cells = [
        (row.layer, row.weights, f"{row.each:,}", row.times, f"{row.parameters:,}") for row in rows
    ]
    print_table(Table(f"Network {args.size!r}, two hands", columns, tuple(cells), ranked=False))
    sums = [(part, f"{count:,}") for part, count in [*parts.items(), ("total", total)]]
    print_table(Table("Parts", (Column("part"), Column("parameters")), tuple(sums), ranked=False))
    return 0


#: What adds the arguments of a command, and what runs it and returns the status.
COMMANDS = {
    "judge": (_add_judge, _do_judge),
    "explain": (_add_explain, _do_explain),
    "network": (_add_network, _do_network),
    "completion": complete("wildghand", "wildghand.cli"),
}
