"""`hwp-bench report`."""

from __future__ import annotations

import argparse

_EXAMPLES = """examples:
  hwp-bench report runs/plain-mini -o reports/plain
  hwp-bench report runs/mine-mini runs/plain-mini -o reports/mine
  hwp-bench report runs/mine-mini runs/mine-mini-clean runs/plain-mini --base plain -o reports/mine
  hwp-bench report runs/* -o reports/all
  hwp-bench report runs/wildghand-mini --avatar-pages -o reports/wildghand
  hwp-bench report runs/mine-captures --captures my_captures/* -o reports/mine

Results on different data get a page each, A/index.html, B/index.html, ..., and index.html leads to
them.

Writes one HTML page, index.html, that needs no network: tables, score against seconds, scores by
perturbation with intervals, a strip for every capture, images, environment and digests.
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
    parser.add_argument("-o", "--out", required=True, metavar="DIR", help="folder of the page")
    parser.add_argument(
        "--captures",
        nargs="+",
        action="extend",
        default=[],
        metavar="FOLDER",
        help="capture folders, for severities (simulated ones are found in the cache)",
    )
    parser.add_argument(
        "--base", metavar="NAME", help="method that shares of the gap are counted from"
    )
    parser.add_argument(
        "--avatar-pages",
        action="store_true",
        help="lead to pages of avatars (captures/ID/avatar.html in a results folder); they run "
        "the scripts of whoever made them",
    )
    parser.add_argument("--title", help="heading of the page (default: the methods)")


def run(args: argparse.Namespace) -> int:
    """Run the command."""
    from pathlib import Path

    from hwp_bench.base.console import notice
    from hwp_bench.base.files import check_places
    from hwp_bench.report.page.mixed import write_reports
    from hwp_bench.report.sources import read_sources, source_folders

    sources = read_sources(args.results, repeats=False)
    inputs = {"RESULTS": source_folders(sources), "--captures": args.captures}
    check_places({"--out": args.out}, inputs)
    pages = write_reports(
        Path(args.out),
        sources,
        args.captures,
        base=args.base,
        title=args.title,
        avatar_pages=args.avatar_pages,
    )
    for page in pages:
        notice(f"report: {page} ({page.stat().st_size / 1e6:.1f} MB)")
    return 0
