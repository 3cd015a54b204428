"""Commands about results: `table`, `compare`, `curves`, `report` and `verify`."""

from __future__ import annotations

import argparse
from dataclasses import asdict, replace
from pathlib import Path
from typing import TYPE_CHECKING

from hwp_bench.base.console import notice, print_document, track
from hwp_bench.base.errors import UsageError
from hwp_bench.base.files import check_places
from hwp_bench.base.tables import Table, format_table, print_table
from hwp_bench.cli.options import (
    SEVERAL,
    add_capture_folders,
    add_json,
    add_overwrite,
    add_results,
    add_splits,
    captures_of,
    named_table,
    print_json,
    say_next,
    splits_of,
)

if TYPE_CHECKING:
    from hwp_bench.evaluation.verify import Verification

_TABLES = (
    *("overall", "rank", "cost", "captures", "perturbations", "details", "micro", "paper"),
    *("robustness", "severity", "clean-share", "novelty", "outline", "free-view", "bias", "seeds"),
    *("sharpness", "discrimination"),
)
# Tables in which a method is compared with a chosen one.
_WITH_BASELINE = ("robustness", "discrimination")
_TABLE = """examples:
  hwp-bench table runs/plain-mini
  hwp-bench table runs/plain-mini runs/mine-mini --by perturbations
  hwp-bench table runs/* --by rank       # ranks with intervals; who is tied with whom
  hwp-bench table runs/* --by cost       # score, seconds, memory, seconds on one core
  hwp-bench table runs/* --by overall --format tex > table.tex
  hwp-bench table runs/mine runs/mine-clean runs/plain-mini --by robustness --baseline plain
  hwp-bench table runs/mine-seed* --by seeds
  hwp-bench table runs/* --by discrimination    # which captures and metrics tell methods apart
  hwp-bench table runs/mine-persistent* runs/plain-persistent* --by clean-share --figure runs
  hwp-bench table runs/plain-mini runs/mine-mini --by novelty   # where training showed little
  hwp-bench table runs/plain-mini runs/mine-mini --by outline   # what is drawn outside of the hand
  hwp-bench table runs/plain-mini runs/mine-mini --by sharpness   # fine structure, by wavelength
  hwp-bench table runs/plain-mini runs/mine-mini --by free-view   # from all around
  hwp-bench table runs/mine-mini runs/plain-mini --paper 5 --published   # layout of table 5
  hwp-bench table --published                                            # the paper's numbers

Results on different data stand in blocks of their own and are never ranked together. The output is
as wide as the terminal, 80 columns in a pipe; COLUMNS=200 asks for more.
docs/tables.md says what each table shows and which command makes each table of the paper.
"""


def _add_table(parser: argparse.ArgumentParser) -> None:
    parser.epilog = _TABLE
    add_results(parser, "*")
    which = parser.add_mutually_exclusive_group().add_argument
    which("--by", choices=_TABLES, default="overall", help="which table (default overall)")
    text = "the layout of the paper's table N, 1 to 10, in protocol paper-wildghand"
    which("--paper", type=int, choices=range(1, 11), metavar="N", help=text)
    add, text = (
        parser.add_argument,
        "append the paper's own numbers, marked as published on other data",
    )
    add("--published", action="store_true", help=text)
    add(
        "--baseline",
        metavar="NAME",
        help="robustness: method from which the gap is counted; discrimination: the ceiling",
    )
    add_capture_folders(parser, "severities, clean shares, novelty, outlines and sharpness")
    forms = ("terminal", "md", "tex", "csv", "json")
    text = "format of the table (default terminal)"
    add("--format", choices=forms, default="terminal", help=text)
    text = "folder for a figure, of --by clean-share"
    add("--figure", type=Path, metavar="DIR", help=text)
    add_json(parser, "the same as --format json")


def _table(args: argparse.Namespace) -> int:
    from hwp_bench.report.requested_table import TableRequest, make_table

    if args.figure is not None and args.by != "clean-share":
        problem = f"there is none of the table {args.by!r}"
        raise UsageError(problem, field="--figure", remedy="Give --by clean-share.")
    if args.baseline is not None and (args.paper or args.by not in _WITH_BASELINE):
        problem = f"the table {args.paper or args.by!r} has none"
        remedy = f"Give --by {' or '.join(_WITH_BASELINE)}."
        raise UsageError(problem, field="--baseline", remedy=remedy)
    request = TableRequest(
        args.results, args.by, args.paper, args.published, args.baseline, args.capture
    )
    _print_table(make_table(request), "json" if args.json else args.format)
    if args.figure is not None:
        from hwp_bench.report.clean_share import write_clean_share
        from hwp_bench.report.sources import find_captures, read_sources

        results = [source.results for source in read_sources(args.results, repeats=False)]
        for path in write_clean_share(args.figure, results, find_captures(results, args.capture)):
            notice(f"figure: {path}")
    return 0


def _print_table(table: Table, form: str, end: str = "") -> None:
    if form == "terminal":
        print_table(table)
    else:
        print_document(format_table(table, form) + end)


_COMPARE = """examples:
  hwp-bench compare runs/mine-mini runs/plain-mini
  hwp-bench compare runs/mine-seed*/ runs/plain-seed*/      # seeds of one method go together
  hwp-bench compare runs/mine runs/other runs/plain --metric psnr ssim --json
  hwp-bench compare runs/mine runs/plain --format md > differences.md

Prints every method with its tie group, and the paired difference of every pair (the first named
less the second) over all captures, single and interacting hands, and each perturbation, with 95 %
interval, P(better) and Holm-adjusted p. Results on different data, splits, protocols or choices
of training frames are refused (exit status 2).
"""


def _add_compare(parser: argparse.ArgumentParser) -> None:
    parser.epilog = _COMPARE
    add_results(parser)
    add = parser.add_argument
    text = "metrics to compare (default: the headline metrics that all have)"
    add("--metric", **SEVERAL, metavar="NAME", help=text)
    add("--resamples", type=int, default=10_000, help="number of resamples (default 10000)")
    add("--seed", type=int, default=0, help="seed of the resampling")
    forms, text = ("terminal", "md", "tex", "csv"), "format of the tables (default terminal)"
    add("--format", choices=forms, default="terminal", help=text)
    add_json(parser, "print JSON with full precision")


def _compare(args: argparse.Namespace) -> int:
    from hwp_bench.analysis.compare import compare_results
    from hwp_bench.base.records import whole_seed
    from hwp_bench.report.tables import HEADLINE
    from hwp_bench.results import read_all
    from hwp_bench.results.schema import add_isolation_note

    results = read_all(args.results)
    comparison = compare_results(
        results,
        args.metric or HEADLINE,
        all_metrics=bool(args.metric),
        resamples=args.resamples,
        seed=whole_seed(args.seed, "--seed"),
    )
    if args.json:
        print_json(comparison.as_dict())
    for table in () if args.json else comparison.tables():
        _print_table(add_isolation_note(table, results), args.format, "\n")
    return 0


_CURVES = """examples:
  hwp-bench curves runs/plain-mini runs/mine-mini
  hwp-bench curves runs/mine-mini --reference runs/plain-mini -o runs/curves
  hwp-bench curves runs/ablation --metric oriented_distance     # every variant of an ablation
  hwp-bench curves runs/* --budgets 10 30 120 --json

Prints scores after fixed times, times to given scores, where the time goes, and which method has
the best score when; writes the tables and the figure of score against seconds (PNG and SVG) to the
output folder. Results on different data are analysed apart: their tables say `Data A`, `Data B`,
... and their figures go to folders of these names.
"""


def _add_curves(parser: argparse.ArgumentParser) -> None:
    parser.epilog = _CURVES
    add_results(parser, more="; seeds of a method go together")
    add = parser.add_argument
    text = "result whose final score is a target (default: the plain baseline, if it is there)"
    add("--reference", metavar="RESULTS", help=text)
    add("--metric", default="psnr", help="metric of the curves (default psnr)")
    times, text = [5.0, 15.0, 60.0, 300.0], "times at which scores are read"
    text += " (default 5 15 60 300, those that are reached)"
    add("--budgets", nargs="+", type=float, default=times, metavar="SECONDS", help=text)
    add("-o", "--out", default="hwp-curves", help="folder to write (default hwp-curves)")
    add_json(parser, "print JSON with the curves")


def _curves(args: argparse.Namespace) -> int:
    from hwp_bench.analysis.cost import CostAnalysis, analyse_cost
    from hwp_bench.analysis.pairing import group_runs
    from hwp_bench.metrics import metric
    from hwp_bench.report.figures import write_cost
    from hwp_bench.report.sources import (
        DataGroup,
        data_groups,
        data_key,
        read_sources,
        source_folders,
    )
    from hwp_bench.results import read_all

    metric(args.metric)
    for budget in args.budgets:
        if not 0 < budget < float("inf"):
            raise UsageError(f"{budget} is not above 0", field="--budgets")
    reference = None
    if args.reference:
        named = group_runs(read_all([args.reference]))
        if len(named) != 1:
            raise UsageError("names more than one method", field="--reference")
        reference = named[0]
    found: list[tuple[DataGroup, CostAnalysis]] = []
    sources = read_sources(args.results, repeats=False)
    check_places({"--out": args.out}, {"RESULTS": source_folders(sources)})
    groups = data_groups(sources)
    data = {data_key(group.sources[0].results) for group in groups}
    if len(groups) > 1 and reference is not None and data_key(reference.first) not in data:
        raise UsageError(
            "is on other data than every result",
            field="--reference",
            remedy="Name a result on the captures of one of them.",
        )
    budgets = sorted(set(args.budgets))
    for group in groups:
        results = [source.results for source in group.sources]
        # With several groups a reference is only of the one that it shares its data with.
        fits = reference is None or data_key(reference.first) == data_key(results[0])
        own = reference if fits or len(groups) == 1 else None
        try:
            analysis = analyse_cost(group_runs(results), args.metric, budgets, own)
        except UsageError as error:
            if len(groups) == 1 or (group is groups[-1] and not found):
                raise
            notice(f"left out, data {group.label}: {error}")
            continue
        found.append((group, analysis))
        head = f"Data {group.label}: " if group.label else ""
        if head and not args.json:
            print(head + group.text)
        for table in () if args.json else analysis.tables.values():
            print_table(replace(table, caption=head + table.caption))
        for figure in write_cost(Path(args.out) / group.label, analysis):
            notice(f"figure: {figure}")
    if args.json:
        several = [{"data": g.label, "text": g.text, **a.as_object()} for g, a in found]
        print_json({"groups": several} if len(found) > 1 else found[0][1].as_object())
    return 0


_REPORT = """examples:
  hwp-bench report runs/plain-mini -o reports/plain
  hwp-bench report runs/mine-mini runs/plain-mini -o reports/mine
  hwp-bench report runs/mine runs/mine-clean runs/plain-mini --baseline plain -o reports/mine
  hwp-bench report runs/* -o reports/all
  hwp-bench report runs/wildghand-mini --avatar-pages -o reports/wildghand
  hwp-bench report runs/mine-captures --capture my_captures/* -o reports/mine

Results on different data get a page each, A/index.html, B/index.html, ..., and index.html leads to
them.

Writes one HTML page, index.html, that needs no network: tables, score against seconds, scores by
perturbation with intervals, a strip for every capture, images, environment and digests.
"""


def _add_report(parser: argparse.ArgumentParser) -> None:
    parser.epilog = _REPORT
    add_results(parser)
    add = parser.add_argument
    add("-o", "--out", required=True, metavar="DIR", help="folder of the page")
    add_capture_folders(parser, "severities")
    add("--baseline", metavar="NAME", help="method from which shares of the gap are counted")
    text = (
        "link to pages of avatars (captures/ID/avatar.html in a results folder); they run "
        "the scripts of whoever made them"
    )
    add("--avatar-pages", action="store_true", help=text)
    add("--title", help="heading of the page (default: the methods)")
    add_overwrite(parser, "an index.html that the toolkit did not write")


def _report(args: argparse.Namespace) -> int:
    from hwp_bench.report.page import write_reports
    from hwp_bench.report.sources import read_sources, source_folders

    sources = read_sources(args.results, repeats=False)
    inputs = {"RESULTS": source_folders(sources), "--capture": args.capture}
    check_places({"--out": args.out}, inputs)
    pages = write_reports(
        Path(args.out),
        sources,
        args.capture,
        base=args.baseline,
        title=args.title,
        avatar_pages=args.avatar_pages,
        overwrite=args.overwrite,
    )
    for page in pages:
        notice(f"report: {page} ({page.stat().st_size / 1e6:.1f} MB)")
    return 0


_VERIFY = """examples:
  hwp-bench verify runs/plain-mini
  hwp-bench verify runs/mine --capture my_captures
  hwp-bench verify runs/ablation --json          # every result of an ablation

Recomputes the digests of captures, splits and predictions, and every score, from the predictions
that lie next to the result. PSNR and SSIM of some frames of each capture are also computed with
scikit-image. Exit status 0: everything is as the result says; 1: something differs.
"""
#: Discrepancies that are printed for one result.
_SHOWN = 20


def _add_verify(parser: argparse.ArgumentParser) -> None:
    parser.epilog = _VERIFY
    add_results(parser)
    text = "captures, or folders of captures (default: the result's suite)"
    parser.add_argument("--capture", **SEVERAL, metavar="PATH", help=text)
    add_splits(parser)
    add_json(parser)


def _verify(args: argparse.Namespace) -> int:
    from hwp_bench.evaluation.verify import verify_results
    from hwp_bench.leaderboard.rules import SUITES
    from hwp_bench.results import read_results, result_files

    splits = splits_of(args)
    files = [file for path in args.results for file in result_files(path)]
    outcomes = [
        verify_results(file, captures_of(args.capture, file), splits)
        for file in track(files, "verify")
    ]
    if args.json:
        print_json([asdict(outcome) for outcome in outcomes])
    for outcome in () if args.json else outcomes:
        _print_verify(outcome)
    status = 1 if any(outcome.discrepancies for outcome in outcomes) else 0
    if status == 0 and all(read_results(file).suite in SUITES for file in files):
        say_next("hwp-bench", "leaderboard", "submit", *args.results, "-o", "submission")
    return status


def _print_verify(outcome: Verification) -> None:
    count = len(outcome.discrepancies)
    if count:
        shown = outcome.discrepancies[:_SHOWN]
        rows = [(d.capture or "all", d.what, d.recorded, d.found) for d in shown]
        print_table(named_table(outcome.file, "capture, what, the result says, found", rows))
    if count > _SHOWN:
        print(f"and {count - _SHOWN} more")
    verdict = f"{count} differences" if count else "holds"
    print(f"{outcome.file}: {verdict} ({outcome.captures} captures, {outcome.frames} frames)")
    if outcome.cross_checked and not count:
        print(f"  scikit-image agrees on PSNR and SSIM of {outcome.cross_checked} frames")
    for note in outcome.notes:
        print(f"  {note}")


#: The arguments and the work of each command, where `main` looks for them.
COMMANDS = {
    "table": (_add_table, _table),
    "compare": (_add_compare, _compare),
    "curves": (_add_curves, _curves),
    "report": (_add_report, _report),
    "verify": (_add_verify, _verify),
}
