"""`hwp-bench leaderboard`."""

from __future__ import annotations

import argparse

_EXAMPLES = """examples:
  hwp-bench leaderboard add runs/mine-mini runs/plain-mini
  hwp-bench leaderboard check
  hwp-bench leaderboard build -o site
  hwp-bench leaderboard build -o site --with runs/mine-mini    # reports with images

An entry is a whole result file with its digest. Only results of a suite, on perturbed frames and
in this version's protocols are taken. The site is static: copy the folder anywhere.
"""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of the command."""
    parser.epilog = _EXAMPLES
    actions = parser.add_subparsers(dest="action", required=True, metavar="ACTION")
    add = actions.add_parser("add", help="make entries of results")
    add.add_argument("results", nargs="+", metavar="RESULTS", help="results folder or results.json")
    check = actions.add_parser("check", help="check schema, digests and comparability of entries")
    build = actions.add_parser("build", help="write the static site")
    build.add_argument("-o", "--out", required=True, metavar="DIR", help="folder of the site")
    build.add_argument(
        "--with",
        dest="folders",
        nargs="+",
        default=[],
        metavar="RESULTS",
        help="results folders of entries, for the images of their reports",
    )
    for action in (add, check, build):
        action.add_argument(
            "--entries", metavar="DIR", help="folder of the entries (default leaderboard/entries)"
        )


def run(args: argparse.Namespace) -> int:
    """Run the command."""
    from pathlib import Path

    from hwp_bench.base.packages import data_folder
    from hwp_bench.base.progress import notice
    from hwp_bench.leaderboard.entries import read_entries
    from hwp_bench.leaderboard.rules import add_entry, check_complete, check_entries

    folder = Path(args.entries) if args.entries else data_folder("leaderboard") / "entries"
    if args.action == "add":
        from hwp_bench.results import read_all

        for results in read_all(args.results):
            notice(f"entry: {add_entry(folder, results)}")
    elif args.action == "check":
        entries = check_entries(read_entries(folder))
        for entry in entries:
            check_complete(entry)
        print(f"{len(entries)} entries, all sound")
    else:
        from hwp_bench.leaderboard.site import build_site
        from hwp_bench.report.sources import read_sources

        page = build_site(Path(args.out), read_entries(folder), read_sources(args.folders))
        notice(f"site: {page}")
    return 0
