"""`hwp-bench table`."""

from __future__ import annotations

import argparse

_TABLES = (
    "overall",
    "rank",
    "cost",
    "captures",
    "perturbations",
    "details",
    "micro",
    "paper",
    "robustness",
    "severity",
    "novelty",
    "outline",
    "free-view",
    "bias",
    "seeds",
)
_EXAMPLES = """examples:
  hwp-bench table runs/plain-mini
  hwp-bench table runs/plain-mini runs/mine-mini --by perturbations
  hwp-bench table runs/* --by rank       # ranks with intervals; who is tied with whom
  hwp-bench table runs/* --by cost       # score, seconds, memory, seconds on one core
  hwp-bench table runs/* --by overall --format tex > table.tex
  hwp-bench table runs/mine-mini runs/mine-mini-clean runs/plain-mini --by robustness --base plain
  hwp-bench table runs/mine-seed* --by seeds
  hwp-bench table runs/plain-mini runs/mine-mini --by novelty   # where training showed little
  hwp-bench table runs/plain-mini runs/mine-mini --by outline   # what is drawn outside of the hand
  hwp-bench table runs/plain-mini runs/mine-mini --by free-view   # from all around
  hwp-bench table runs/mine-mini runs/plain-mini --paper 5 --published   # layout of table 5
  hwp-bench table --published                                            # the paper's numbers

Results on different data stand in blocks of their own and are never ranked together. The output is
as wide as the terminal, 80 columns in a pipe; COLUMNS=200 asks for more.
docs/tables.md says what each table shows and which command makes each table of the paper.
"""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of the command."""
    parser.epilog = _EXAMPLES
    parser.add_argument(
        "results",
        nargs="*",
        metavar="RESULTS",
        help="results folder, results.json, or ablation folder",
    )
    which = parser.add_mutually_exclusive_group()
    which.add_argument(
        "--by", choices=_TABLES, default="overall", help="which table (default overall)"
    )
    which.add_argument(
        "--paper",
        type=int,
        choices=range(1, 11),
        metavar="N",
        help="the layout of the paper's table N, 1 to 10, in protocol paper-wildghand",
    )
    parser.add_argument(
        "--published",
        action="store_true",
        help="append the paper's own numbers, marked as published on other data",
    )
    parser.add_argument(
        "--base", metavar="NAME", help="robustness: method that the gap is counted from"
    )
    parser.add_argument(
        "--captures",
        nargs="+",
        action="extend",
        default=[],
        metavar="FOLDER",
        help="capture folders, for severities, novelty and outlines (simulated ones are found in "
        "the cache)",
    )
    parser.add_argument(
        "--format",
        choices=("terminal", "md", "tex", "csv", "json"),
        default="terminal",
        help="format of the table (default terminal)",
    )
    parser.add_argument("--json", action="store_true", help="the same as --format json")


def run(args: argparse.Namespace) -> int:
    """Run the command."""
    from hwp_bench.base.console import print_document
    from hwp_bench.base.tables import format_table, print_table
    from hwp_bench.report.requested_table import TableRequest, make_table

    table = make_table(
        TableRequest(
            paths=args.results,
            by=args.by,
            paper=args.paper,
            published=args.published,
            base=args.base,
            captures=args.captures,
        )
    )
    form = "json" if args.json else args.format
    if form == "terminal":
        print_table(table)
    else:
        print_document(format_table(table, form))
    return 0
