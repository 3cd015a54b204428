"""`hwp-bench cost`."""

from __future__ import annotations

import argparse
import json
import sys

_EXAMPLES = """examples:
  hwp-bench cost runs/plain-mini runs/mine-mini
  hwp-bench cost runs/mine-mini --reference runs/plain-mini -o runs/cost
  hwp-bench cost runs/ablation --metric oriented_distance     # every variant of an ablation
  hwp-bench cost runs/* --budgets 10 30 120 --json

Prints scores after fixed times, times to given scores, where the time goes, and which method has
the best score when; writes the tables and the figure of score against seconds (PNG and SVG) to the
output folder. Results on different data are analysed apart: their tables say `Data A`, `Data B`,
... and their figures go to folders of these names.
"""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of the command."""
    parser.epilog = _EXAMPLES
    parser.add_argument(
        "results",
        nargs="+",
        metavar="RESULTS",
        help="results folder, results.json, or ablation folder; seeds of a method go together",
    )
    parser.add_argument(
        "--reference",
        metavar="RESULTS",
        help="result whose final score is a target (default: the plain baseline, if it is there)",
    )
    parser.add_argument("--metric", default="psnr", help="metric of the curves (default psnr)")
    parser.add_argument(
        "--budgets",
        nargs="+",
        type=float,
        default=[5.0, 15.0, 60.0, 300.0],
        metavar="SECONDS",
        help="times at which scores are read (default 5 15 60 300, those that are reached)",
    )
    parser.add_argument(
        "-o", "--out", default="hwp-cost", help="folder to write (default hwp-cost)"
    )
    parser.add_argument("--json", action="store_true", help="print JSON with the curves")


def run(args: argparse.Namespace) -> int:
    """Run the command."""
    from dataclasses import replace
    from pathlib import Path

    from hwp_bench.analysis.cost.analysis import CostAnalysis, analyse_cost
    from hwp_bench.analysis.statistics.pairing import group_runs
    from hwp_bench.base.console import notice
    from hwp_bench.base.errors import UsageError
    from hwp_bench.base.files import check_places
    from hwp_bench.base.tables import print_table
    from hwp_bench.metrics import metric
    from hwp_bench.report.data_groups import DataGroup, data_groups, data_key
    from hwp_bench.report.figures import write_cost
    from hwp_bench.report.sources import read_sources, source_folders
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
    for group in groups:
        results = [source.results for source in group.sources]
        # With several groups a reference is only of the one that it shares its data with.
        fits = reference is None or data_key(reference.first) == data_key(results[0])
        try:
            analysis = analyse_cost(
                group_runs(results),
                args.metric,
                budgets=sorted(set(args.budgets)),
                reference=reference if fits or len(groups) == 1 else None,
            )
        except UsageError as error:
            if len(groups) == 1 or (group is groups[-1] and not found):
                raise
            notice(f"left out, data {group.label}: {error}")
            continue
        found.append((group, analysis))
        if not args.json:
            if group.label:
                print(f"Data {group.label}: {group.text}")
            for table in analysis.tables.values():
                head = f"Data {group.label}: " if group.label else ""
                print_table(replace(table, caption=head + table.caption))
        for figure in write_cost(Path(args.out) / group.label, analysis):
            notice(f"figure: {figure}")
    if args.json:
        several = {"groups": [{"data": g.label, "text": g.text, **a.as_object()} for g, a in found]}
        whole = several if len(found) > 1 else found[0][1].as_object()
        json.dump(whole, sys.stdout, indent=1, allow_nan=False)
        print()
    return 0
