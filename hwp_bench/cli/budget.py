"""`hwp-bench budget`."""

from __future__ import annotations

import argparse
import json
import sys
from contextlib import nullcontext
from pathlib import Path
from typing import TYPE_CHECKING

from hwp_bench.cli.evaluate import add_evaluation_arguments

if TYPE_CHECKING:
    from hwp_bench.evaluation.budget.runs import BudgetRuns
    from hwp_bench.evaluation.evaluate import OnCapture

_EXAMPLES = """examples:
  hwp-bench budget wildghand --suite mini --budget 16 --jobs 2
  hwp-bench budget baselines/plain --capture my_capture
  hwp-bench budget my_method --capture capture4 --truths poses test-poses --json

Each truth that a simulated capture knows replaces one estimate (pixels, masks, poses, test-poses,
betas, mesh), then all of them do; the method is fitted each time. What a capture does not know is
left out: of a real one the corrections of the rendered test frames remain. Started again with the
same arguments, it takes finished captures as they are.
Exit status 1: the method failed on a capture or left out frames.
"""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of the command."""
    parser.epilog = _EXAMPLES
    parser.add_argument(
        "method", metavar="METHOD_DIR", help="method directory, or the name of a shipped method"
    )
    parser.add_argument(
        "--truths",
        nargs="*",
        metavar="NAME",
        help="estimates that the truth replaces (default: all that the captures know)",
    )
    add_evaluation_arguments(parser)
    parser.add_argument("-o", "--out", help="folder (default runs/budget-METHOD-SUITE)")
    parser.add_argument("--seed", type=int, default=0, help="seed of everything random")
    parser.add_argument("--json", action="store_true", help="print the record, budget.json")


def run(args: argparse.Namespace) -> int:
    """Run the command."""
    from hwp_bench.base.console import JobsView, notice
    from hwp_bench.capture.splits import read_splits
    from hwp_bench.cli.evaluate import chosen_captures, evaluation_settings, look_ahead
    from hwp_bench.evaluation.budget.runs import check_truths, run_budget
    from hwp_bench.methods.manifest import find_method, read_manifest
    from hwp_bench.methods.material import TRUTHS
    from hwp_bench.run.engine.options import engine_for, needs_of

    settings = evaluation_settings(args)
    manifest = read_manifest(find_method(args.method))
    truths = tuple(TRUTHS) if args.truths is None else args.truths
    check_truths(truths, settings)
    out = Path(args.out or f"runs/budget-{manifest.name}-{settings.suite}")
    splits = read_splits(args.splits) if args.splits else None
    rehearse = look_ahead(args, manifest, settings, out, splits)
    with engine_for(args) as engine:
        captures = chosen_captures(args, engine)
        with JobsView() if engine.in_turn else nullcontext() as view:

            def on_run(index: int, count: int, name: str) -> OnCapture | None:
                notice(f"{index + 1} of {count}: {name}")
                return view.turn if view else None

            runs = run_budget(
                args.method,
                captures,
                out,
                settings,
                truths,
                splits=splits,
                on_run=on_run,
                engine=engine,
                needs=needs_of(args),
                overwrite=args.overwrite,
                rehearse=rehearse,
            )
    return _report(runs, out, print_json=args.json)


def _report(runs: BudgetRuns, out: Path, *, print_json: bool) -> int:
    from hwp_bench.base.console import notice
    from hwp_bench.base.files import write_json
    from hwp_bench.base.images import write_image
    from hwp_bench.base.tables import print_table, write_tables
    from hwp_bench.evaluation.budget.budget import budget_tables, make_budget, next_work
    from hwp_bench.evaluation.budget.picture import budget_sheet
    from hwp_bench.evaluation.outcome import outcome_lines
    from hwp_bench.results.walls import noted

    budget = make_budget(runs)
    evaluations = list(runs.results.values())
    tables = {name: noted(table, evaluations) for name, table in budget_tables(budget).items()}
    write_tables(out / "tables", tables)
    record = write_json(out / "budget.json", budget.to_json())
    picture = write_image(out / "budget.png", budget_sheet(runs, budget))
    if print_json:
        json.dump(budget.to_json(), sys.stdout, indent=1, allow_nan=False)
        print()
    elif any(result.drawn for result in evaluations):
        print_table(tables["budget"])
        print(next_work(budget))
    notice(f"record: {record}; tables: {out / 'tables'}; picture: {picture}")
    status = 0
    for name, results in runs.results.items():
        for line in outcome_lines(runs.folders[name], results, f"{name}: "):
            notice(line)
        status |= any(capture.failed_frames for capture in results.captures)
    return int(status)
