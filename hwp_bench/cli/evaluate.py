"""`hwp-bench evaluate`."""

from __future__ import annotations

import argparse
import json
import sys
from contextlib import nullcontext
from pathlib import Path
from typing import TYPE_CHECKING

from hwp_bench.run.engine.options import add_engine_arguments
from hwp_bench.taxonomy import SUITES

if TYPE_CHECKING:
    from collections.abc import Mapping

    from hwp_bench.capture.splits import Split
    from hwp_bench.evaluation.evaluate import EvaluationSettings
    from hwp_bench.methods.manifest import MethodManifest
    from hwp_bench.publish import SealedPart
    from hwp_bench.results import Results
    from hwp_bench.run.engine import Engine

_EXAMPLES = """examples:
  hwp-bench evaluate baselines/plain --suite smoke
  hwp-bench evaluate baselines/plain --capture my_capture --out runs/plain-mine
  hwp-bench evaluate my_method --suite mini --budget 60 --seed 1
  hwp-bench evaluate my_method --suite mini --set gaussians=20000 --json
  hwp-bench evaluate baselines/plain --suite mini --frames clean     # upper bound
  hwp-bench evaluate submission --sealed publication/sealed
  hwp-bench evaluate my_method --suite mini --jobs 4                 # four captures at once
  hwp-bench evaluate my_method --suite full --engine ray://10.0.0.1:6379 --job-gpus 1

An evaluation that is started again with the same arguments keeps finished captures. A folder with
results of other arguments is refused, and what differs is said; with --overwrite they are
replaced once all new ones are there.
Exit status 0: every frame was scored; 1: the method failed on a capture or left out frames
(they get the protocol's penalty); 2: the command line is wrong.
"""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of the command."""
    parser.epilog = _EXAMPLES
    parser.add_argument(
        "method", metavar="METHOD_DIR", help="method directory, or the name of a shipped method"
    )
    add_evaluation_arguments(parser)
    parser.add_argument(
        "--sealed",
        metavar="DIR",
        help="sealed part of a publication, instead of captures; checked against its commitment",
    )
    parser.add_argument(
        "-o",
        "--out",
        help="results folder (default runs/METHOD-SUITE; "
        "oracle, budget and a seed other than 0 are added to the name)",
    )
    parser.add_argument("--seed", type=int, default=0, help="seed of everything random")
    parser.add_argument("--json", action="store_true", help="print the result file")


def add_evaluation_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of every command that runs a method: captures, settings, limits."""
    what = parser.add_mutually_exclusive_group()
    what.add_argument(
        "--suite",
        choices=SUITES,
        default="mini",
        help="simulated captures, rendered on first use (default mini)",
    )
    what.add_argument(
        "--capture",
        nargs="+",
        action="extend",
        metavar="PATH",
        help="capture folders, instead of a suite",
    )
    parser.add_argument("--splits", help="split file (default: the 80/10/10 rule)")
    parser.add_argument("--preset", help="preset of the method (default: the suite's, if any)")
    parser.add_argument(
        "--set",
        action="append",
        default=[],
        metavar="NAME=VALUE",
        help="override one setting of the preset; may be given again",
    )
    parser.add_argument(
        "--frames",
        choices=("perturbed", "clean", "unperturbed-only"),
        default="perturbed",
        help="training frames to use; all but the first are oracles on simulated captures",
    )
    parser.add_argument("--budget", type=float, metavar="SECONDS", help="limit of the fit's time")
    parser.add_argument("--steps", type=int, help="limit of the fit's optimizer steps")
    parser.add_argument(
        "--time-limit",
        type=float,
        default=3600.0,
        metavar="SECONDS",
        help="kill the method after this time on one capture (default 3600)",
    )
    parser.add_argument(
        "--memory-limit",
        type=float,
        metavar="GB",
        help="kill the method when it takes more memory (default: nine tenths of what is free)",
    )
    parser.add_argument(
        "--isolation",
        choices=("auto", "required", "none"),
        default="auto",
        help="run the method without network and other files: where the system allows it (auto), "
        "always or not at all (required), or never (none)",
    )
    parser.add_argument(
        "--expose",
        nargs="+",
        action="extend",
        default=[],
        metavar="PATH",
        help="further files and folders that an isolated method may read, such as weights or the "
        "environment of another Python",
    )
    parser.add_argument(
        "--overwrite",
        action="store_true",
        help="replace results of another evaluation in the folder, once the new ones are whole",
    )
    add_engine_arguments(parser)


def run(args: argparse.Namespace) -> int:
    """Run the command."""
    from dataclasses import asdict, replace

    from hwp_bench.base.console import JobsView
    from hwp_bench.base.tables import print_table
    from hwp_bench.capture.splits import read_splits
    from hwp_bench.evaluation.evaluate import default_folder, evaluate
    from hwp_bench.methods.manifest import find_method, read_manifest
    from hwp_bench.report.evaluation_tables import all_tables
    from hwp_bench.report.free_view_table import free_view_tables
    from hwp_bench.run.engine.options import engine_for, needs_of

    settings = evaluation_settings(args)
    sealed = _sealed_part(args)
    if sealed is not None:
        settings = replace(settings, suite=f"sealed-{sealed.commitment[:12]}")
    manifest = read_manifest(find_method(args.method))
    out = Path(args.out) if args.out else default_folder(args.method, settings)
    splits = read_splits(args.splits) if args.splits else None
    if sealed is not None:
        splits = sealed.splits
    rehearse = look_ahead(args, manifest, settings, out, splits)
    with engine_for(args) as engine:
        captures = chosen_captures(args, engine) if sealed is None else list(sealed.captures)
        with JobsView() if engine.in_turn else nullcontext() as jobs:
            results = evaluate(
                args.method,
                captures,
                out,
                settings,
                splits=splits,
                on_capture=jobs.turn if jobs else None,
                engine=engine,
                needs=needs_of(args),
                overwrite=args.overwrite,
                rehearse=rehearse,
            )
    if args.json:
        json.dump(asdict(results), sys.stdout, indent=1)
        print()
    elif results.drawn:
        novel = free_view_tables([results])
        tables = {**all_tables([results]), **novel}
        for name in ("overall", "captures", *novel):
            print_table(tables[name])
    return report_outcome(out, results)


def look_ahead(
    args: argparse.Namespace,
    manifest: MethodManifest,
    settings: EvaluationSettings,
    out: Path,
    splits: Mapping[str, Split] | None,
) -> bool:
    """Report whatever is wrong with a call before a suite is rendered for it.

    Returns:
        Whether the method is still to be made once before the first capture.

    Raises:
        HwpError: as `check_results_place`, `check_call` and `check_suite`.
    """
    from hwp_bench.evaluation.foresight import check_call, check_results_place, check_suite

    inputs = {
        "--capture": args.capture,
        "--sealed": getattr(args, "sealed", None),
        "--splits": args.splits,
    }
    check_results_place(manifest, out, inputs)
    check_call(manifest, settings, out, "--set", overwrite=args.overwrite)
    local = args.engine == "local"
    if args.capture or getattr(args, "sealed", None):
        return local
    return local and not check_suite(manifest, settings, out, splits, rehearse=local)


def _sealed_part(args: argparse.Namespace) -> SealedPart | None:
    """Open the sealed part that is asked for, and print its commitment."""
    if args.sealed is None:
        return None
    from hwp_bench.base.console import notice
    from hwp_bench.base.errors import UsageError
    from hwp_bench.publish import open_sealed

    if args.capture or args.splits:
        raise UsageError("has its own captures and splits", field="--sealed")
    sealed = open_sealed(args.sealed)
    notice(f"sealed part is as committed to: {sealed.commitment}")
    return sealed


def report_outcome(out: Path, results: Results) -> int:
    """Print where the results are and which frames failed; returns the exit status."""
    from hwp_bench.base.console import notice
    from hwp_bench.evaluation.outcome import outcome_lines

    for line in outcome_lines(out, results):
        notice(line)
    notice(f"results: {out / 'results.json'}; tables: {out / 'tables'}")
    for capture in results.captures:
        picture = out / "captures" / capture.id / "pictures" / "comparison.png"
        if picture.is_file():
            notice(f"images: {picture}")
    return 1 if any(capture.failed_frames for capture in results.captures) else 0


def evaluation_settings(args: argparse.Namespace) -> EvaluationSettings:
    """Return the settings that `add_evaluation_arguments` and `--seed` gave.

    Raises:
        UsageError: a limit is not above 0, or an override is not NAME=VALUE.
    """
    from hwp_bench.base.errors import UsageError
    from hwp_bench.cli.overrides import overrides
    from hwp_bench.evaluation.evaluate import EvaluationSettings
    from hwp_bench.methods.contract import Budget, RunSettings
    from hwp_bench.run.sandbox.confinement import Confinement

    for name in ("budget", "steps", "time_limit", "memory_limit"):
        value = getattr(args, name)
        if value is not None and not 0 < value < float("inf"):
            raise UsageError(f"{value} is not above 0", field=f"--{name.replace('_', '-')}")
    return EvaluationSettings(
        suite="captures" if args.capture else args.suite,
        preset=args.preset,
        run=RunSettings(
            overrides(args.set), args.seed, Budget(args.budget, args.steps), args.frames
        ),
        time_limit=args.time_limit,
        confinement=Confinement(
            mode=args.isolation,
            memory_limit=None if args.memory_limit is None else int(args.memory_limit * 1e9),
            exposed=tuple(Path(path) for path in args.expose),
        ),
    )


def chosen_captures(args: argparse.Namespace, engine: Engine) -> list[Path]:
    """Return the capture folders that were named, or the suite, rendered if it is missing."""
    if args.capture:
        return [Path(path) for path in args.capture]
    from hwp_bench.run.engine.options import needs_of
    from hwp_bench.sim import ensure_suite

    return ensure_suite(args.suite, engine=engine, needs=needs_of(args))
