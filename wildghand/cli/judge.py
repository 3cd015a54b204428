"""`wildghand judge`."""

from __future__ import annotations

import argparse
import json
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    import numpy as np

    from hwp_bench.capture import Capture
    from wildghand.prepass import FrameAssessment

_EXAMPLES = """examples:
  wildghand judge my_capture
  wildghand judge my_capture -o judgement.json --picture judgement.png

Estimates for every frame the probability that it is clean, and the severity (0-5) of each
perturbation that the capture lists, or of all four if it lists none. Whether a frame is perturbed
is much more certain than which perturbation it is; docs/prepass.md has the numbers. The capture is
not changed.
"""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of the command."""
    parser.epilog = _EXAMPLES
    parser.add_argument("capture", type=Path, help="capture folder")
    parser.add_argument("-o", "--out", type=Path, metavar="FILE", help="JSON file to write")
    parser.add_argument(
        "--picture", type=Path, metavar="FILE", help="PNG file to write: the estimates over time"
    )
    parser.add_argument("--json", action="store_true", help="print JSON")


def run(args: argparse.Namespace) -> int:
    """Run the command."""
    from hwp_bench.base.files import check_places, write_json
    from hwp_bench.capture import open_capture

    outputs = {"--out": args.out, "--picture": args.picture}
    check_places(outputs, {"CAPTURE": args.capture})
    capture = open_capture(args.capture)
    assessment, levels = _judge(capture)
    record = _record(capture, assessment, levels)
    if args.out is not None:
        write_json(args.out, record)
    if args.picture is not None:
        _draw(assessment, levels, args.picture)
    if args.json:
        json.dump(record, sys.stdout, indent=1)
        print()
    else:
        _print(capture, assessment, levels)
    return 0


def _judge(capture: Capture) -> tuple[FrameAssessment, dict[str, np.ndarray]]:
    import numpy as np

    from hwp_bench.base.console import track
    from wildghand.prepass import capture_input, estimated_severity, judge_frames

    every = np.arange(len(capture))
    assessment = judge_frames(capture_input(capture, every, track(every.tolist(), "Reading")))
    levels = estimated_severity(assessment)
    listed = capture.info.perturbations
    return assessment, {kind: level for kind, level in levels.items() if kind in (listed or levels)}


def _record(
    capture: Capture, assessment: FrameAssessment, levels: dict[str, np.ndarray]
) -> dict[str, Any]:
    return {
        "capture": capture.info.id,
        "estimated": True,
        "clean": [round(value, 4) for value in assessment.clean.tolist()],
        "usable": assessment.usable.tolist(),
        "severity": {kind: level.tolist() for kind, level in levels.items()},
    }


def _print(capture: Capture, assessment: FrameAssessment, levels: dict[str, np.ndarray]) -> None:
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


def _draw(assessment: FrameAssessment, levels: dict[str, np.ndarray], path: Path) -> None:
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
