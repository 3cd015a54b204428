"""`hwp-bench demo`."""

from __future__ import annotations

import argparse
import time
from pathlib import Path

_EXAMPLES = """examples:
  hwp-bench demo
  hwp-bench demo --out my-demo

Renders the two captures of the smoke suite, fits the plain baseline to their training frames,
scores it on their test frames, prints the table and the seconds of each step, and writes a
sheet of images. Needs no data and no network.
"""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of the command."""
    parser.epilog = _EXAMPLES
    parser.add_argument("--out", default="hwp-demo", help="folder to write (default hwp-demo)")
    parser.add_argument("--method", default="plain", help="method to run (default plain)")


def run(args: argparse.Namespace) -> int:
    """Run the command."""
    from hwp_bench.base.progress import JobsView
    from hwp_bench.base.tables import Column, Table, print_table, write_tables
    from hwp_bench.cli.evaluate import report_outcome
    from hwp_bench.evaluation.evaluate import EvaluationSettings, evaluate
    from hwp_bench.report.evaluation_tables import all_tables
    from hwp_bench.sim import ensure_suite

    out = Path(args.out)
    clock = _Clock()
    captures = ensure_suite("smoke")
    clock.lap("simulated captures (rendered once, then cached)")
    with JobsView() as jobs:
        results = evaluate(
            args.method, captures, out, EvaluationSettings("smoke"), on_capture=jobs.turn
        )
    clock.lap(f"{results.method.title}: fit, render, score, pictures")
    tables = all_tables([results])
    write_tables(out / "tables", tables)
    print_table(tables["overall"])
    print_table(tables["captures"])
    columns = (Column("step"), Column("seconds", 1))
    print_table(Table("Time of this demo", columns, tuple(clock.laps)))
    return report_outcome(out, results)


class _Clock:
    """Seconds between one lap and the next."""

    def __init__(self) -> None:
        self._last = time.perf_counter()
        self.laps: list[tuple[str, float]] = []

    def lap(self, name: str) -> None:
        """End a step."""
        now = time.perf_counter()
        self.laps.append((name, now - self._last))
        self._last = now
