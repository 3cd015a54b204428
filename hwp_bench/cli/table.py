"""`hwp-bench table`."""

from __future__ import annotations

import argparse

_EXAMPLES = """examples:
  hwp-bench table runs/plain-mini
  hwp-bench table runs/plain-mini runs/mine-mini --by perturbations
  hwp-bench table runs/* --by overall --format tex > table.tex
  hwp-bench table runs/plain-mini --by paper --format csv
"""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of the command."""
    parser.epilog = _EXAMPLES
    parser.add_argument(
        "results", nargs="+", metavar="RESULTS", help="results folder or results.json"
    )
    parser.add_argument(
        "--by",
        choices=("overall", "captures", "perturbations", "details", "micro", "paper"),
        default="overall",
        help="which table (default overall)",
    )
    parser.add_argument(
        "--format",
        choices=("terminal", "md", "tex", "csv", "json"),
        default="terminal",
        help="spelling of the table (default terminal)",
    )
    parser.add_argument("--json", action="store_true", help="the same as --format json")


def run(args: argparse.Namespace) -> int:
    """Run the command."""
    from hwp_bench.report.summary import all_tables
    from hwp_bench.report.table import print_table, spell
    from hwp_bench.results import read_results

    table = all_tables([read_results(path) for path in args.results])[args.by]
    form = "json" if args.json else args.format
    if form == "terminal":
        print_table(table)
    else:
        print(spell(table, form), end="")
    return 0
