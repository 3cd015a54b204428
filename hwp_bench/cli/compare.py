"""`hwp-bench compare`."""

from __future__ import annotations

import argparse
import json
import sys

_EXAMPLES = """examples:
  hwp-bench compare runs/mine-mini runs/plain-mini
  hwp-bench compare runs/mine-seed*/ runs/plain-seed*/      # seeds of one method go together
  hwp-bench compare runs/mine runs/other runs/plain --metric psnr ssim --json
  hwp-bench compare runs/mine runs/plain --format md > differences.md

Prints every method with its tie group, and the paired difference of every pair (the first named
less the second) over all captures, single and interacting hands, and each perturbation, with 95 %
interval, P(better) and Holm-adjusted p. Results on different data, splits, protocols or choices
of training frames are refused (exit status 2).
"""


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
        "--metric",
        nargs="+",
        action="extend",
        default=[],
        metavar="NAME",
        help="metrics to compare (default: the headline metrics that all have)",
    )
    parser.add_argument("--resamples", type=int, default=10_000, help="default 10000")
    parser.add_argument("--seed", type=int, default=0, help="seed of the resampling")
    parser.add_argument(
        "--format",
        choices=("terminal", "md", "tex", "csv"),
        default="terminal",
        help="format of the tables (default terminal)",
    )
    parser.add_argument("--json", action="store_true", help="print JSON with full precision")


def run(args: argparse.Namespace) -> int:
    """Run the command."""
    from hwp_bench.analysis.compare import compare_results
    from hwp_bench.base.console import print_document
    from hwp_bench.base.tables import format_table, print_table
    from hwp_bench.report.tables import HEADLINE
    from hwp_bench.results import read_all
    from hwp_bench.results.walls import noted

    results = read_all(args.results)
    comparison = compare_results(
        results,
        args.metric or HEADLINE,
        all_metrics=bool(args.metric),
        resamples=args.resamples,
        seed=args.seed,
    )
    if args.json:
        json.dump(comparison.as_dict(), sys.stdout, indent=1)
        print()
        return 0
    for plain in comparison.tables():
        table = noted(plain, results)
        if args.format == "terminal":
            print_table(table)
        else:
            print_document(format_table(table, args.format) + "\n")
    return 0
