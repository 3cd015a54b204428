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
    from wildghand.prepass import Judgement

_EXAMPLES = """examples:
  wildghand judge my_capture
  wildghand judge my_capture -o judgement.json --picture judgement.png

Judges every frame by the pre-pass: how likely it is clean, and how strongly each perturbation that
the capture lists may act, 0-5, where the capture does not know it itself (all four where it lists
none). Whether a frame is perturbed is much surer than by what: docs/prepass.md has the numbers.
The capture is left as it is.
"""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of the command."""
    parser.epilog = _EXAMPLES
    parser.add_argument("capture", type=Path, help="capture folder")
    parser.add_argument("-o", "--out", type=Path, metavar="FILE", help="JSON file to write")
    parser.add_argument("--picture", type=Path, metavar="FILE", help="PNG of the course in time")
    parser.add_argument("--json", action="store_true", help="print JSON")


def run(args: argparse.Namespace) -> int:
    """Run the command."""
    from hwp_bench.base.files import write_json
    from hwp_bench.capture import open_capture

    capture = open_capture(args.capture)
    judgement, levels = _judge(capture)
    record = _record(capture, judgement, levels)
    if args.out is not None:
        write_json(args.out, record)
    if args.picture is not None:
        _draw(judgement, levels, args.picture)
    if args.json:
        json.dump(record, sys.stdout, indent=1)
        print()
    else:
        _print(capture, judgement, levels)
    return 0


def _judge(capture: Capture) -> tuple[Judgement, dict[str, np.ndarray]]:
    import numpy as np

    from hwp_bench.base.progress import track
    from wildghand.prepass.judge import capture_input, judge_frames
    from wildghand.prepass.severity import estimated_severity

    every = np.arange(len(capture))
    judgement = judge_frames(capture_input(capture, every, track(every.tolist(), "Reading")))
    levels = estimated_severity(judgement)
    listed = capture.info.perturbations
    return judgement, {kind: level for kind, level in levels.items() if kind in (listed or levels)}


def _record(
    capture: Capture, judgement: Judgement, levels: dict[str, np.ndarray]
) -> dict[str, Any]:
    return {
        "capture": capture.info.id,
        "estimated": True,
        "clean": [round(value, 4) for value in judgement.clean.tolist()],
        "usable": judgement.usable.tolist(),
        "severity": {kind: level.tolist() for kind, level in levels.items()},
    }


def _print(capture: Capture, judgement: Judgement, levels: dict[str, np.ndarray]) -> None:
    from hwp_bench.base.tables import Column, Table, print_table

    count = len(judgement)
    rows: list[tuple[str, int, float | None]] = [
        ("judged clean", int((judgement.clean >= 0.5).sum()), None),
        ("judged perturbed", int((judgement.usable & (judgement.clean < 0.5)).sum()), None),
        ("cannot be judged", count - int(judgement.usable.sum()), None),
    ]
    for kind, level in levels.items():
        acting = level[level > 0]
        mean = float(acting.mean()) if len(acting) else None
        rows.append((kind.replace("_", " "), len(acting), mean))
    columns = (Column("estimate"), Column("frames"), Column("mean level", 1))
    print_table(Table(f"{capture.info.id}, {count} frames", columns, tuple(rows), ranked=False))


def _draw(judgement: Judgement, levels: dict[str, np.ndarray], path: Path) -> None:
    import io

    from matplotlib.figure import Figure

    from hwp_bench.base.files import atomic_write

    figure = Figure(figsize=(9.0, 3.6), layout="constrained")
    clean, severity = figure.subplots(2, 1, sharex=True)
    clean.plot(judgement.indices, judgement.clean, color="black")
    clean.set(ylabel="probability clean", ylim=(-0.05, 1.05))
    for kind, level in levels.items():
        severity.step(judgement.indices, level, where="mid", label=kind.replace("_", " "))
    severity.set(ylabel="estimated severity", xlabel="frame", ylim=(-0.2, 5.2))
    severity.legend(fontsize=7, loc="center left", bbox_to_anchor=(1.0, 0.5))
    memory = io.BytesIO()
    figure.savefig(memory, format="png", dpi=110)
    atomic_write(path, memory.getvalue())
