"""`hwp-bench dev`: what keeps this repository as it should be."""

from __future__ import annotations

import argparse
from pathlib import Path

from hwp_bench.base.console import notice
from hwp_bench.base.packages import PACKAGES

_RESULTS = """examples:
  hwp-bench dev docs-results
  hwp-bench dev docs-results --check

Pages of the documentation have blocks of results, between `<!-- results: NAME -->` and
`<!-- end -->`. They are written from leaderboard/entries, benchmarks/ratios.json and
benchmarks/tuning.jsonl. Exit status of --check: 0: all is well; 1: a block is not what its source
says, or a decibel outside of the blocks has no source (docs/results.toml).
"""


def _add_docs_results(parser: argparse.ArgumentParser) -> None:
    parser.epilog = _RESULTS
    parser.add_argument("--check", action="store_true", help="write nothing; say what is wrong")
    text = "checkout of the repository (default: the one that this program is of)"
    parser.add_argument("--root", default=str(PACKAGES), metavar="DIR", help=text)


def _docs_results(args: argparse.Namespace) -> int:
    from hwp_bench.leaderboard.pages import find_faults, write_pages

    if args.check:
        faults = find_faults(Path(args.root))
        for fault in faults:
            print(fault)
        return 1 if faults else 0
    for file in write_pages(Path(args.root)):
        notice(f"written: {file}")
    return 0


#: The arguments and the work of each command, where `main` looks for them.
COMMANDS = {"docs-results": (_add_docs_results, _docs_results)}
