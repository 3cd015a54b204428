"""Commands that run methods: `evaluate`, `ablate`, `budget` and `demo`."""

from __future__ import annotations

import argparse
import time
from collections.abc import Iterator
from contextlib import contextmanager, nullcontext
from pathlib import Path
from typing import TYPE_CHECKING, Any

from hwp_bench.cli.options import (
    add_json,
    add_suite_or_captures,
    overrides,
    print_json,
    splits_of,
)
from hwp_bench.run.engine.options import add_engine_arguments

if TYPE_CHECKING:
    from collections.abc import Mapping

    from hwp_bench.base.console import JobsView
    from hwp_bench.capture.splits import Split
    from hwp_bench.evaluation.ablate.runs import AblationRuns
    from hwp_bench.evaluation.budget.budget import BudgetRuns
    from hwp_bench.evaluation.evaluate import EvaluationSettings, OnCapture
    from hwp_bench.methods.manifest import MethodManifest
    from hwp_bench.publish import SealedPart
    from hwp_bench.results import Results

_EVALUATE = """examples:
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


def add_evaluate(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of `evaluate`."""
    parser.epilog = _EVALUATE
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
    add_json(parser, "print the result file")


def add_evaluation_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of every command that runs a method: captures, settings, limits."""
    add_suite_or_captures(parser)
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


def do_evaluate(args: argparse.Namespace) -> int:
    """Run `evaluate`."""
    from dataclasses import asdict, replace

    from hwp_bench.base.tables import print_table
    from hwp_bench.evaluation.evaluate import default_folder, evaluate
    from hwp_bench.methods.manifest import find_method, read_manifest
    from hwp_bench.report.tables import all_tables, free_view_tables

    settings = evaluation_settings(args)
    sealed = _sealed_part(args)
    if sealed is not None:
        settings = replace(settings, suite=f"sealed-{sealed.commitment[:12]}")
    manifest = read_manifest(find_method(args.method))
    out = Path(args.out) if args.out else default_folder(args.method, settings)
    splits = splits_of(args)
    if sealed is not None:
        splits = sealed.splits
    with _running(args, manifest, settings, out, splits, sealed) as (captures, jobs, options):
        results = evaluate(
            args.method,
            captures,
            out,
            settings,
            on_capture=jobs.turn if jobs else None,
            **options,
        )
    if args.json:
        print_json(asdict(results))
    elif results.drawn:
        novel = free_view_tables([results])
        tables = {**all_tables([results]), **novel}
        for name in ("overall", "captures", *novel):
            print_table(tables[name])
    return report_outcome(out, results)


@contextmanager
def _running(
    args: argparse.Namespace,
    manifest: MethodManifest,
    settings: EvaluationSettings,
    out: Path,
    splits: Mapping[str, Split] | None,
    sealed: SealedPart | None = None,
) -> Iterator[tuple[list[Path], JobsView | None, dict[str, Any]]]:
    """Check a call, then give captures, a view of the jobs, and the options of what runs them.

    Whatever is wrong with the call is reported before a suite is rendered for it.

    Raises:
        HwpError: as `check_results_place`, `check_call` and `check_suite`.
    """
    from hwp_bench.base.console import JobsView
    from hwp_bench.evaluation.evaluate import check_call, check_results_place, check_suite
    from hwp_bench.run.engine.options import engine_for, needs_of
    from hwp_bench.sim import ensure_suite

    folder = getattr(args, "sealed", None)
    inputs = {"--capture": args.capture, "--sealed": folder, "--splits": args.splits}
    check_results_place(manifest, out, inputs)
    check_call(manifest, settings, out, "--set", overwrite=args.overwrite)
    # Whether the method is still to be made once before the first capture.
    rehearse = args.engine == "local"
    if not args.capture and not folder:
        rehearse = rehearse and not check_suite(manifest, settings, out, splits, rehearse=rehearse)
    with engine_for(args) as engine:
        needs = needs_of(args)
        if sealed is not None:
            captures = list(sealed.captures)
        elif args.capture:
            captures = [Path(path) for path in args.capture]
        else:
            captures = ensure_suite(args.suite, engine=engine, needs=needs)
        options = {
            "splits": splits,
            "engine": engine,
            "needs": needs,
            "overwrite": args.overwrite,
            "rehearse": rehearse,
        }
        with JobsView() if engine.in_turn else nullcontext() as jobs:
            yield captures, jobs, options


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
    from hwp_bench.evaluation.sentences import outcome_lines

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


_ABLATE = """examples:
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


def add_ablate(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of `ablate`."""
    parser.epilog = _ABLATE
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
    add_json(parser, "print the record, ablation.json")


def do_ablate(args: argparse.Namespace) -> int:
    """Run `ablate`."""
    from hwp_bench.base.console import notice
    from hwp_bench.base.errors import UsageError
    from hwp_bench.evaluation.ablate.runs import make_design, run_ablation
    from hwp_bench.methods.manifest import check_settings, find_method, read_manifest

    if not 1 <= args.seeds <= 100:
        raise UsageError(f"{args.seeds} is not between 1 and 100", field="--seeds")
    args.seed = 0
    settings = evaluation_settings(args)
    # A wrong method, setting or switch must be reported before a suite is rendered for it.
    manifest = read_manifest(find_method(args.method))
    check_settings(manifest, settings.run.settings, "--set")
    design = make_design(manifest, args.thrown or [], args.only)
    out = Path(args.out or f"runs/ablation-{manifest.name}-{settings.suite}")
    splits = splits_of(args)
    with _running(args, manifest, settings, out, splits) as (captures, jobs, options):
        names = ", ".join(variant.name for variant in design.variants)
        notice(f"{len(design.variants)} variants: {names}")
        ablation = run_ablation(
            manifest,
            design,
            captures,
            out,
            settings,
            range(args.seeds),
            on_job=jobs.turn if jobs else None,
            **options,
        )
    return _report_ablate(ablation, out, as_json=args.json)


def _report_ablate(ablation: AblationRuns, out: Path, *, as_json: bool) -> int:
    from hwp_bench.analysis.pairing import common_metrics
    from hwp_bench.base.console import notice
    from hwp_bench.base.tables import print_table, write_tables
    from hwp_bench.evaluation.ablate.effects import (
        ablation_record,
        ablation_tables,
        cost_effects,
        score_effects,
        write_record,
    )
    from hwp_bench.evaluation.ablate.runs import result_folder
    from hwp_bench.evaluation.sentences import outcome_lines
    from hwp_bench.report.tables import HEADLINE
    from hwp_bench.results.schema import add_isolation_note

    metrics = common_metrics(list(ablation.runs.values()), HEADLINE)
    effects = score_effects(ablation, metrics)
    costs = cost_effects(ablation)
    found = ablation_tables(ablation, effects, costs)
    tables = {name: add_isolation_note(table, ablation.results) for name, table in found.items()}
    record = ablation_record(ablation, effects, costs, tables)
    write_tables(out / "tables", tables)
    if as_json:
        print_json(record)
    elif any(result.drawn for result in ablation.results):
        for name in ("ablation", "effects", "component_cost", "seconds"):
            if name in tables:
                print_table(tables[name])
    _draw_ablate(ablation, out)
    notice(f"record: {write_record(out, record)}; tables: {out / 'tables'}")
    for name, runs in ablation.runs.items():
        for seed, result in runs.seeds.items():
            head = f"{result.method.title}, seed {seed}, "
            for line in outcome_lines(out / result_folder(name, seed), result, head):
                notice(line)
    failed = any(item.failed_frames for result in ablation.results for item in result.captures)
    return 1 if failed else 0


def _draw_ablate(ablation: AblationRuns, out: Path) -> None:
    from hwp_bench.analysis.cost import analyse_cost
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


_BUDGET = """examples:
  hwp-bench budget wildghand --suite mini --budget 16 --jobs 2
  hwp-bench budget baselines/plain --capture my_capture
  hwp-bench budget my_method --capture capture4 --truths poses test-poses --json

Each truth that a simulated capture knows replaces one estimate (pixels, masks, poses, test-poses,
betas, mesh), then all of them do; the method is fitted each time. What a capture does not know is
left out: of a real one the corrections of the rendered test frames remain. Started again with the
same arguments, it takes finished captures as they are.
Exit status 1: the method failed on a capture or left out frames.
"""


def add_budget(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of `budget`."""
    parser.epilog = _BUDGET
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
    add_json(parser, "print the record, budget.json")


def do_budget(args: argparse.Namespace) -> int:
    """Run `budget`."""
    from hwp_bench.base.console import notice
    from hwp_bench.evaluation.budget.budget import check_oracle_inputs, run_budget
    from hwp_bench.methods.manifest import find_method, read_manifest
    from hwp_bench.methods.request import ORACLE_INPUTS

    settings = evaluation_settings(args)
    manifest = read_manifest(find_method(args.method))
    truths = tuple(ORACLE_INPUTS) if args.truths is None else args.truths
    check_oracle_inputs(truths, settings)
    out = Path(args.out or f"runs/budget-{manifest.name}-{settings.suite}")
    splits = splits_of(args)
    with _running(args, manifest, settings, out, splits) as (captures, jobs, options):

        def on_run(index: int, count: int, name: str) -> OnCapture | None:
            notice(f"{index + 1} of {count}: {name}")
            return jobs.turn if jobs else None

        runs = run_budget(args.method, captures, out, settings, truths, on_run=on_run, **options)
    return _report_budget(runs, out, as_json=args.json)


def _report_budget(runs: BudgetRuns, out: Path, *, as_json: bool) -> int:
    from hwp_bench.base.console import notice
    from hwp_bench.base.files import write_json
    from hwp_bench.base.images import write_image
    from hwp_bench.base.tables import print_table, write_tables
    from hwp_bench.evaluation.budget.budget import (
        budget_sheet,
        budget_tables,
        make_budget,
        next_work,
    )
    from hwp_bench.evaluation.sentences import outcome_lines
    from hwp_bench.results.schema import add_isolation_note

    budget = make_budget(runs)
    evaluations = list(runs.results.values())
    tables = {
        name: add_isolation_note(table, evaluations)
        for name, table in budget_tables(budget).items()
    }
    write_tables(out / "tables", tables)
    record = write_json(out / "budget.json", budget.to_json())
    picture = write_image(out / "budget.png", budget_sheet(runs, budget))
    if as_json:
        print_json(budget.to_json())
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


_DEMO = """examples:
  hwp-bench demo
  hwp-bench demo --out my-demo
  hwp-bench demo --methods plain my_method/

Renders the two captures of the smoke suite, fits the plain baseline and WildGHand to their
training frames, scores both on the test frames, prints the tables and the seconds of each step,
and draws truth and methods side by side. Needs no data and no network. Started again it takes
finished fits as they are.
"""


def add_demo(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of `demo`."""
    parser.epilog = _DEMO
    parser.add_argument("--out", default="hwp-demo", help="folder to write (default hwp-demo)")
    parser.add_argument(
        "--methods",
        nargs="+",
        default=["plain", "wildghand"],
        metavar="METHOD",
        help="methods to run: directories or shipped names (default plain wildghand)",
    )
    parser.add_argument(
        "--overwrite",
        action="store_true",
        help="replace results of other versions of the methods in the folder",
    )


def do_demo(args: argparse.Namespace) -> int:
    """Run `demo`."""
    from hwp_bench.base.console import JobsView, notice
    from hwp_bench.base.tables import Column, Table, print_table, write_tables
    from hwp_bench.capture import open_capture
    from hwp_bench.evaluation.artifacts import write_side_by_side
    from hwp_bench.evaluation.evaluate import (
        EvaluationSettings,
        check_call,
        check_results_place,
        check_suite,
        evaluate,
    )
    from hwp_bench.methods import find_method, read_manifest
    from hwp_bench.report.sources import ResultsSource
    from hwp_bench.report.tables import all_tables
    from hwp_bench.sim import ensure_suite

    out = Path(args.out)
    manifests = [read_manifest(find_method(method)) for method in args.methods]
    names = [manifest.name for manifest in manifests]
    for manifest in manifests:
        folder, settings = out / manifest.name, EvaluationSettings("smoke")
        check_results_place(manifest, out, {})
        check_call(manifest, settings, folder, overwrite=args.overwrite)
        check_suite(manifest, settings, folder)
    clock = _Clock()
    captures = ensure_suite("smoke")
    clock.lap("simulated captures (rendered once, then cached)")
    sources, status = [], 0
    for method, name in zip(args.methods, names, strict=True):
        with JobsView() as jobs:
            results = evaluate(
                method,
                captures,
                out / name,
                EvaluationSettings("smoke"),
                on_capture=jobs.turn,
                overwrite=args.overwrite,
            )
        clock.lap(f"{results.method.title}: fit, render, score, pictures")
        sources.append(ResultsSource(results, out / name))
        status = max(status, report_outcome(out / name, results))
    tables = all_tables([source.results for source in sources])
    write_tables(out / "tables", tables)
    print_table(tables["overall"])
    print_table(tables["captures"])
    columns = (Column("step"), Column("seconds", 1))
    print_table(Table("Time of this demo", columns, tuple(clock.laps)))
    picture = out / "side-by-side.png"
    write_side_by_side(picture, sources, [open_capture(capture) for capture in captures])
    notice(f"truth and methods side by side: {picture}; tables: {out / 'tables'}")
    return status


class _Clock:
    """Seconds between one lap and the next."""

    def __init__(self) -> None:
        self._last = time.perf_counter()
        self.laps: list[tuple[str, float]] = []

    def lap(self, name: str) -> None:
        """End a step."""
        now = time.perf_counter()
        self.laps.append((name, now - self._last))
        self._last = now


#: The arguments and the work of each command, where `main` looks for them.
COMMANDS = {
    "evaluate": (add_evaluate, do_evaluate),
    "ablate": (add_ablate, do_ablate),
    "budget": (add_budget, do_budget),
    "demo": (add_demo, do_demo),
}
