"""`hwp-bench verify`."""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from hwp_bench.evaluation.verify import Verification

_EXAMPLES = """examples:
  hwp-bench verify runs/plain-mini
  hwp-bench verify runs/mine --captures my_captures
  hwp-bench verify runs/ablation --json          # every result of an ablation

Recomputes the digests of captures, splits and predictions, and every score, from the predictions
that lie next to the result. PSNR and SSIM of some frames of each capture are also computed with
scikit-image. Exit status 0: everything is as the result says; 1: something differs.
"""
#: Discrepancies that are printed for one result.
_SHOWN = 20


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of the command."""
    parser.epilog = _EXAMPLES
    parser.add_argument(
        "results",
        nargs="+",
        metavar="RESULTS",
        help="results folder, results.json, or ablation folder",
    )
    parser.add_argument(
        "--captures",
        nargs="+",
        action="extend",
        metavar="DIR",
        help="captures, or folders of captures (default: the result's suite)",
    )
    parser.add_argument("--splits", help="split file (default: the 80/10/10 rule)")
    parser.add_argument("--json", action="store_true", help="print JSON")


def run(args: argparse.Namespace) -> int:
    """Run the command."""
    from dataclasses import asdict

    from hwp_bench.base.console import track
    from hwp_bench.capture.splits import read_splits
    from hwp_bench.evaluation.verify import verify_results
    from hwp_bench.results import result_files

    splits = read_splits(args.splits) if args.splits else None
    files = [file for path in args.results for file in result_files(path)]
    outcomes = []
    for file in track(files, "verify"):
        outcomes.append(verify_results(file, captures_of(args.captures, file), splits))
    if args.json:
        json.dump([asdict(outcome) for outcome in outcomes], sys.stdout, indent=1)
        print()
    else:
        for outcome in outcomes:
            _print(outcome)
    return 1 if any(outcome.discrepancies for outcome in outcomes) else 0


def captures_of(places: Sequence[str] | None, file: Path) -> list[Path]:
    """Return the capture folders that a result is verified with.

    Args:
        places: captures or folders of captures; None takes the result's suite, rendered where
            it is not in the cache.
        file: the result file.

    Raises:
        UsageError: the places hold no capture, or the result is of no suite.
    """
    from hwp_bench.base.errors import UsageError
    from hwp_bench.evaluation.verify import capture_folders
    from hwp_bench.results import read_results
    from hwp_bench.sim import ensure_suite
    from hwp_bench.sim.produce.suites import suite_names

    if places:
        folders = capture_folders([Path(place) for place in places])
        if not folders:
            raise UsageError("there is no capture", field="--captures")
        return folders
    suite = read_results(file).suite
    if suite not in suite_names():
        raise UsageError(
            f"was not made on a suite ({suite})",
            where=file,
            field="suite",
            remedy="Say where its captures lie with --captures.",
        )
    return ensure_suite(suite)


def _print(outcome: Verification) -> None:
    from hwp_bench.base.tables import Column, Table, print_table

    shown = outcome.discrepancies[:_SHOWN]
    if shown:
        titles = ("capture", "what", "the result says", "found")
        rows = tuple((d.capture or "all", d.what, d.recorded, d.found) for d in shown)
        print_table(Table(outcome.file, tuple(map(Column, titles)), rows, ranked=False))
        rest = len(outcome.discrepancies) - len(shown)
        if rest:
            print(f"and {rest} more")
    verdict = f"{len(outcome.discrepancies)} differences" if shown else "holds"
    print(f"{outcome.file}: {verdict} ({outcome.captures} captures, {outcome.frames} frames)")
    if outcome.cross_checked and not shown:
        print(f"  scikit-image agrees on PSNR and SSIM of {outcome.cross_checked} frames")
    for note in outcome.notes:
        print(f"  {note}")
