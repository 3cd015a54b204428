"""`hwp-bench demo`."""

from __future__ import annotations

import argparse
import time
from pathlib import Path

_EXAMPLES = """examples:
  hwp-bench demo
  hwp-bench demo --out my-demo
  hwp-bench demo --methods plain my_method/

Renders the two captures of the smoke suite, fits the plain baseline and WildGHand to their
training frames, scores both on the test frames, prints the tables and the seconds of each step,
and draws truth and methods side by side. Needs no data and no network. Started again it takes
finished fits as they are.
"""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of the command."""
    parser.epilog = _EXAMPLES
    parser.add_argument("--out", default="hwp-demo", help="folder to write (default hwp-demo)")
    parser.add_argument(
        "--methods",
        nargs="+",
        default=["plain", "wildghand"],
        metavar="METHOD",
        help="methods to run: directories or shipped names (default plain wildghand)",
    )
    parser.add_argument(
        "--overwrite",
        action="store_true",
        help="replace results of other versions of the methods in the folder",
    )


def run(args: argparse.Namespace) -> int:
    """Run the command."""
    from hwp_bench.base.console import JobsView, notice
    from hwp_bench.base.tables import Column, Table, print_table, write_tables
    from hwp_bench.capture import open_capture
    from hwp_bench.cli.evaluate import report_outcome
    from hwp_bench.evaluation.evaluate import EvaluationSettings, evaluate
    from hwp_bench.evaluation.foresight import check_call, check_results_place, check_suite
    from hwp_bench.evaluation.side_by_side import write_side_by_side
    from hwp_bench.methods import find_method, read_manifest
    from hwp_bench.report.evaluation_tables import all_tables
    from hwp_bench.report.sources import ResultsSource
    from hwp_bench.sim import ensure_suite

    out = Path(args.out)
    manifests = [read_manifest(find_method(method)) for method in args.methods]
    names = [manifest.name for manifest in manifests]
    for manifest in manifests:
        folder, settings = out / manifest.name, EvaluationSettings("smoke")
        check_results_place(manifest, out, {})
        check_call(manifest, settings, folder, overwrite=args.overwrite)
        check_suite(manifest, settings, folder)
    clock = _Clock()
    captures = ensure_suite("smoke")
    clock.lap("simulated captures (rendered once, then cached)")
    sources, status = [], 0
    for method, name in zip(args.methods, names, strict=True):
        with JobsView() as jobs:
            results = evaluate(
                method,
                captures,
                out / name,
                EvaluationSettings("smoke"),
                on_capture=jobs.turn,
                overwrite=args.overwrite,
            )
        clock.lap(f"{results.method.title}: fit, render, score, pictures")
        sources.append(ResultsSource(results, out / name))
        status = max(status, report_outcome(out / name, results))
    tables = all_tables([source.results for source in sources])
    write_tables(out / "tables", tables)
    print_table(tables["overall"])
    print_table(tables["captures"])
    columns = (Column("step"), Column("seconds", 1))
    print_table(Table("Time of this demo", columns, tuple(clock.laps)))
    picture = out / "side-by-side.png"
    write_side_by_side(picture, sources, [open_capture(capture) for capture in captures])
    notice(f"truth and methods side by side: {picture}; tables: {out / 'tables'}")
    return status


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
