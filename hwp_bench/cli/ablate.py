"""`hwp-bench ablate`."""

from __future__ import annotations

import argparse
import json
import sys
from contextlib import nullcontext
from pathlib import Path
from typing import TYPE_CHECKING

from hwp_bench.cli.evaluate import add_evaluation_arguments

if TYPE_CHECKING:
    from hwp_bench.evaluation.ablate.runs import AblationRuns

_EXAMPLES = """examples:
  hwp-bench ablate --suite mini                          # DPD x PAO x pre-pass, three seeds
  hwp-bench ablate --no-dpd --no-pao                     # DPD x PAO
  hwp-bench ablate --no-dpd                              # the full method, and without DPD
  hwp-bench ablate --no-dpd --no-pao --no-heads          # each out of the full method, all out
  hwp-bench ablate --binary-mask                         # a binary mask in place of PAO's weights
  hwp-bench ablate --only dpd pao heads                  # 2 x 2 x 2
  hwp-bench ablate my_method --without loss --budget 60  # what a third party's method declares
  hwp-bench ablate --suite full --engine ray://10.0.0.1:6379 --job-gpus 1

Which variants are run:
  no flag         the components that the method names for it, or else the first two that it
                  declares, crossed: 2^k
  --only A B ...  the named components, crossed: 2^k
  other flags     the full method; each of the named components out of it (alternatives: put in);
                  and, of two components or more, all of them out

Started again with the same arguments, it takes finished jobs as they are; results of other settings
are refused, or replaced at the end with --overwrite. Exit status 1: the method failed on a capture
or left out frames.
"""
#: Flags of the reference method's switches.
_FLAGS = {
    "dpd": "take out the dynamic perturbation disentanglement",
    "pao": "take out the perturbation-aware optimization",
    "heads": "take out heads (iii) and (iv)",
}


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of the command."""
    parser.epilog = _EXAMPLES
    parser.add_argument(
        "method",
        metavar="METHOD",
        nargs="?",
        default="wildghand",
        help="method directory or name (default wildghand)",
    )
    for name, text in _FLAGS.items():
        parser.add_argument(
            f"--no-{name}", dest="thrown", action="append_const", const=name, help=text
        )
    parser.add_argument(
        "--binary-mask",
        dest="thrown",
        action="append_const",
        const="binary-mask",
        help="put a binary mask in place of the weights",
    )
    parser.add_argument(
        "--without",
        dest="thrown",
        action="append",
        metavar="SWITCH",
        help="throw a switch of the method's method.toml; may be given again",
    )
    parser.add_argument(
        "--only",
        nargs="+",
        action="extend",
        default=[],
        metavar="COMPONENT",
        help="cross these components",
    )
    add_evaluation_arguments(parser)
    parser.add_argument("--seeds", type=int, default=3, help="number of seeds (default 3)")
    parser.add_argument("-o", "--out", help="folder (default runs/ablation-METHOD-SUITE)")
    parser.add_argument("--json", action="store_true", help="print the record, ablation.json")


def run(args: argparse.Namespace) -> int:
    """Run the command."""
    from hwp_bench.base.console import JobsView, notice
    from hwp_bench.base.errors import UsageError
    from hwp_bench.capture.splits import read_splits
    from hwp_bench.cli.evaluate import chosen_captures, evaluation_settings, look_ahead
    from hwp_bench.evaluation.ablate.design import make_design
    from hwp_bench.evaluation.ablate.runs import run_ablation
    from hwp_bench.methods.manifest import find_method, read_manifest
    from hwp_bench.methods.setting_files import check_settings
    from hwp_bench.run.engine.options import engine_for, needs_of

    if not 1 <= args.seeds <= 100:
        raise UsageError(f"{args.seeds} is not between 1 and 100", field="--seeds")
    args.seed = 0
    settings = evaluation_settings(args)
    # A wrong method, setting or switch must be reported before a suite is rendered for it.
    manifest = read_manifest(find_method(args.method))
    check_settings(manifest, settings.run.settings, "--set")
    design = make_design(manifest, args.thrown or [], args.only)
    out = Path(args.out or f"runs/ablation-{manifest.name}-{settings.suite}")
    splits = read_splits(args.splits) if args.splits else None
    rehearse = look_ahead(args, manifest, settings, out, splits)
    names = ", ".join(variant.name for variant in design.variants)
    notice(f"{len(design.variants)} variants: {names}")
    with engine_for(args) as engine:
        captures = chosen_captures(args, engine)
        with JobsView() if engine.in_turn else nullcontext() as view:
            ablation = run_ablation(
                manifest,
                design,
                captures,
                out,
                settings,
                range(args.seeds),
                splits=splits,
                on_job=view.turn if view else None,
                engine=engine,
                needs=needs_of(args),
                overwrite=args.overwrite,
                rehearse=rehearse,
            )
    return _report(ablation, out, print_json=args.json)


def _report(ablation: AblationRuns, out: Path, *, print_json: bool) -> int:
    from hwp_bench.analysis.statistics.pairing import common_metrics
    from hwp_bench.base.console import notice
    from hwp_bench.base.tables import print_table, write_tables
    from hwp_bench.evaluation.ablate.ablation_tables import (
        ablation_record,
        ablation_tables,
        write_record,
    )
    from hwp_bench.evaluation.ablate.effects import cost_effects, score_effects
    from hwp_bench.evaluation.ablate.runs import result_folder
    from hwp_bench.evaluation.outcome import outcome_lines
    from hwp_bench.report.evaluation_tables import HEADLINE
    from hwp_bench.results.walls import noted

    metrics = common_metrics(list(ablation.runs.values()), HEADLINE)
    effects = score_effects(ablation, metrics)
    costs = cost_effects(ablation)
    found = ablation_tables(ablation, effects, costs)
    tables = {name: noted(table, ablation.results) for name, table in found.items()}
    record = ablation_record(ablation, effects, costs, tables)
    write_tables(out / "tables", tables)
    if print_json:
        json.dump(record, sys.stdout, indent=1, allow_nan=False)
        print()
    elif any(result.drawn for result in ablation.results):
        for name in ("ablation", "effects", "component_cost", "seconds"):
            if name in tables:
                print_table(tables[name])
    _draw(ablation, out)
    notice(f"record: {write_record(out, record)}; tables: {out / 'tables'}")
    for name, runs in ablation.runs.items():
        for seed, result in runs.seeds.items():
            head = f"{result.method.title}, seed {seed}, "
            for line in outcome_lines(out / result_folder(name, seed), result, head):
                notice(line)
    failed = any(item.failed_frames for result in ablation.results for item in result.captures)
    return 1 if failed else 0


def _draw(ablation: AblationRuns, out: Path) -> None:
    from hwp_bench.analysis.cost.analysis import analyse_cost
    from hwp_bench.base.console import notice
    from hwp_bench.base.errors import UsageError
    from hwp_bench.report.figures import write_cost

    try:
        analysis = analyse_cost(list(ablation.runs.values()), "psnr")
    except UsageError as error:
        notice(f"no figure of accuracy against time: {error.problem}")
        return
    for figure in write_cost(out / "cost", analysis):
        notice(f"figure: {figure}")
