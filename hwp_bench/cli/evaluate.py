"""Commands that run methods: `evaluate`, `ablate`, `error-budget` and `demo`."""

from __future__ import annotations

import argparse
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, nullcontext
from dataclasses import asdict, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

from hwp_bench.base.console import JobsView, notice
from hwp_bench.base.errors import BadMethod, MethodFailed, UsageError
from hwp_bench.base.tables import Column, Table, print_table, to_object, write_tables
from hwp_bench.cli.options import (
    SEVERAL,
    add_json,
    add_overwrite,
    add_suite_or_captures,
    overrides,
    print_json,
    say_next,
    splits_of,
)
from hwp_bench.run.engine.options import add_engine_arguments

if TYPE_CHECKING:
    from hwp_bench.commitments import SealedPart
    from hwp_bench.evaluation.ablate.runs import AblationRuns
    from hwp_bench.evaluation.budget.budget import BudgetRuns
    from hwp_bench.evaluation.capture_evaluation import EvaluationSettings
    from hwp_bench.evaluation.evaluate import OnCapture
    from hwp_bench.methods.manifest import MethodManifest
    from hwp_bench.results import Results

_EVALUATE = """examples:
  hwp-bench evaluate baselines/plain --suite smoke
  hwp-bench evaluate baselines/plain --capture my_capture --out runs/plain-mine
  hwp-bench evaluate my_method --suite mini --budget 60 --seed 1
  hwp-bench evaluate my_method --suite mini --set gaussians=20000 --json
  hwp-bench evaluate baselines/plain --suite mini --train-on clean   # upper bound
  hwp-bench evaluate submission --sealed publication/sealed
  hwp-bench evaluate authors --capture compat/capture0     # after `data import rendered`
  hwp-bench evaluate my_method --suite mini --jobs 4                 # four captures at once
  hwp-bench evaluate my_method --suite full --engine ray://10.0.0.1:6379 --job-gpus 1
  hwp-bench evaluate plain trimmed my_method --suite wild-test --seeds 3 --budget 64 -o runs/field

Several methods or seeds have a folder each, OUT/METHOD/seed-N; one table at the end compares them,
and `hwp-bench table OUT` shows others. A method that cannot be run is named and left out.

An evaluation that is started again with the same arguments keeps finished captures. A folder with
results of other arguments is refused, with what differs; with --overwrite they are
replaced once all new ones are there.
Exit status 0: every frame was scored; 1: the method failed on a capture or left out frames
(they get the protocol's penalty); 2: the command line is wrong.
"""
METHOD_HELP = "method directory, or the name of a shipped method"


def _add_evaluate(parser: argparse.ArgumentParser) -> None:
    parser.epilog = _EVALUATE
    add = parser.add_argument
    add("methods", nargs="+", metavar="METHOD_DIR", help=METHOD_HELP)
    sealed = "sealed part of a publication, instead of captures; checked against its commitment"
    _add_evaluation(parser, sealed)
    out = "oracle, budget and a seed other than 0 are added to the name"
    text = f"results folder (default runs/METHOD-SUITE, of several runs/field-SUITE; {out})"
    add("-o", "--out", help=text)
    seeds = parser.add_mutually_exclusive_group()
    seeds.add_argument("--seed", type=int, default=0, help="seed of all random numbers")
    text = "evaluate with the seeds 0 to N - 1 (default: with one seed)"
    seeds.add_argument("--seeds", type=int, default=1, metavar="N", help=text)
    add_json(parser, "print the result file; of several methods or seeds, files and table")


def _add_evaluation(parser: argparse.ArgumentParser, sealed: str = "") -> None:
    """Add the arguments of every command that runs a method: captures, settings, limits."""
    add_suite_or_captures(parser, sealed)
    add = parser.add_argument
    add("--preset", help="preset of the method (default: the suite's, if any)")
    text = "override one setting of the preset; may be given again"
    add("--set", action="append", default=[], metavar="NAME=VALUE", help=text)
    kinds = ("perturbed", "clean", "unperturbed-only")
    text = "training frames to use; all but the first are oracles on simulated captures"
    add("--train-on", choices=kinds, default="perturbed", help=text)
    text = "limit of the fit's time; without --steps it lifts the preset's limit of steps"
    add("--budget", type=float, metavar="SECONDS", help=text)
    add("--steps", type=int, help="limit of the fit's optimizer steps")
    text = "kill the method after this time on one capture (default: 3600 more than --budget)"
    add("--time-limit", type=float, metavar="SECONDS", help=text)
    text = "kill the method when it takes more memory (default: nine tenths of what is free)"
    add("--memory-limit", type=float, metavar="GB", help=text)
    text = (
        "run the method without network and other files: where the system allows it (auto), "
        "always or not at all (required), or never (none)"
    )
    add("--isolation", choices=("auto", "required", "none"), default="auto", help=text)
    text = (
        "further files and folders that an isolated method may read, such as weights or the "
        "environment of another Python"
    )
    add("--expose", **SEVERAL, metavar="PATH", help=text)
    add_overwrite(parser, "results of another evaluation, once the new ones are whole")
    add_engine_arguments(parser)


def _evaluate(args: argparse.Namespace) -> int:
    from hwp_bench.evaluation.evaluate import default_folder, evaluate
    from hwp_bench.methods.manifest import find_method, read_manifest
    from hwp_bench.report.tables import all_tables, free_view_tables

    _check_seeds(args.seeds)
    settings = _evaluation_settings(args)
    sealed = _sealed_part(args)
    if sealed is not None:
        settings = replace(settings, suite=f"sealed-{sealed.commitment[:12]}")
    if len(args.methods) > 1 or args.seeds > 1:
        return _evaluate_several(args, settings, sealed)
    (method,) = args.methods
    out = Path(args.out) if args.out else default_folder(method, settings)
    call = Call(read_manifest(find_method(method)), settings, out)
    with _running(args, [call], sealed) as (captures, jobs, options):
        turn = jobs.turn if jobs else None
        results = evaluate(method, captures, out, settings, on_capture=turn, **options)
    if args.json:
        print_json(asdict(results))
    elif results.drawn:
        novel = free_view_tables([results])
        tables = {**all_tables([results]), **novel}
        for name in ("overall", "perturbations", "captures", *novel):
            # Captures of a person's own may have no perturbation to speak of.
            if len(tables[name].columns) > 1:
                print_table(tables[name])
    status = _report_outcome(out, results)
    if status:
        folders = sealed.captures if sealed else args.capture
        where = ["--capture", *folders] if folders else []
        if not where and call.manifest.kind == "predictions":
            # There are none of the toy capture, which other methods are checked on.
            where = ["--suite", args.suite]
        say_next("hwp-bench", "check-method", method, *where)
    else:
        say_next("hwp-bench", "report", out, "-o", Path("reports") / out.name)
    return status


class Call(NamedTuple):
    """A method, how it is evaluated, and its results folder."""

    manifest: MethodManifest
    settings: EvaluationSettings
    out: Path


def _evaluate_several(
    args: argparse.Namespace, settings: EvaluationSettings, sealed: SealedPart | None
) -> int:
    """Evaluate several methods and seeds, seed by seed, and compare them in one table."""
    from hwp_bench.evaluation.evaluate import default_folder, evaluate
    from hwp_bench.methods.manifest import find_method, read_manifest
    from hwp_bench.report.requested_table import TableRequest, make_table
    from hwp_bench.results.store import seed_folder

    out = Path(args.out) if args.out else default_folder("field", settings)
    manifests = [read_manifest(find_method(method)) for method in args.methods]
    names = [manifest.name for manifest in manifests]
    twice = next((name for name in names if names.count(name) > 1), None)
    if twice is not None:
        problem = f"{twice!r} is the name of two of the methods, and of one folder"
        raise UsageError(problem, field="METHOD_DIR", remedy="Name each method once.")
    calls = []
    for seed in range(args.seeds) if args.seeds > 1 else [args.seed]:
        own = replace(settings, run=replace(settings.run, seed=seed))
        calls += [Call(each, own, seed_folder(out, each.name, seed)) for each in manifests]
    done, status = [], 0
    made: set[str] = set()
    with _running(args, calls, sealed) as (captures, jobs, options):
        rehearse = options["rehearse"]
        for index, (manifest, own, folder) in enumerate(calls):
            head = f"{manifest.title}, seed {own.run.seed}, "
            notice(f"{head}{index + 1} of {len(calls)}")
            # A method that was made once can be made with every seed.
            options["rehearse"] = rehearse and manifest.name not in made
            options["on_capture"] = jobs.turn if jobs else None
            try:
                results = evaluate(str(manifest.root), captures, folder, own, **options)
            except (BadMethod, MethodFailed) as error:
                # The others are worth having, and this one can be started again.
                notice(f"{head}not evaluated: {error}")
                status = 1
                continue
            made.add(manifest.name)
            status |= _notice_failures(folder, results, head)
            done += [folder] if results.drawn else []
    by = "rank" if len(manifests) > 1 else "seeds"
    table = make_table(TableRequest(done, by)) if done else None
    if args.json:
        files = [str(folder / "results.json") for folder in done]
        print_json({"results": files, "table": table and to_object(table)})
    elif table is not None:
        print_table(table)
    notice(f"results: {out}; more tables: hwp-bench table {out} --by NAME")
    if len(manifests) > 1:
        say_next("hwp-bench", "compare", out)
    say_next("hwp-bench", "report", out, "-o", Path("reports") / out.name)
    return status


def _check_seeds(count: int) -> None:
    if not 1 <= count <= 100:
        raise UsageError(f"{count} is not between 1 and 100", field="--seeds")


@contextmanager
def _running(
    args: argparse.Namespace, calls: Sequence[Call], sealed: SealedPart | None = None
) -> Iterator[tuple[list[Path], JobsView | None, dict[str, Any]]]:
    """Check calls, then give captures, a view of the jobs, and the options of what runs them.

    Whatever is wrong with a call is reported before a suite is rendered for it.
    """
    from hwp_bench.evaluation.evaluate import check_call, check_results_place, check_suite
    from hwp_bench.run.engine.options import engine_for, needs_of
    from hwp_bench.suites.suite import ensure_suite

    splits = splits_of(args) if sealed is None else sealed.splits
    folder = getattr(args, "sealed", None)
    inputs = {"--capture": args.capture, "--sealed": folder, "--splits": args.splits}
    for manifest, settings, out in calls:
        check_results_place(manifest, out, inputs)
        check_call(manifest, settings, out, "--set", overwrite=args.overwrite)
    # Whether the methods are still to be made once before the first capture.
    rehearse = local = args.engine == "local"
    if not args.capture and not folder:
        # Seeds of one method are alike.
        methods, faulty = {each.manifest.name: each for each in calls}, 0
        for call in methods.values():
            try:
                rehearse = not check_suite(*call, splits, rehearse=local) and rehearse
            except (BadMethod, MethodFailed) as error:
                faulty += 1
                if faulty == len(methods):
                    raise
                notice(f"{call.manifest.title}: {error}")
        # In its turn it is made again, named and left out.
        rehearse = rehearse or (local and faulty > 0)
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
    from hwp_bench.commitments import open_sealed

    if args.splits:
        raise UsageError("has its own splits", field="--sealed", remedy="Leave out --splits.")
    sealed = open_sealed(args.sealed)
    notice(f"sealed part is as committed to: {sealed.commitment}")
    return sealed


def _report_outcome(out: Path, results: Results) -> int:
    """Print where the results are and which frames failed; returns the exit status."""
    status = _notice_failures(out, results)
    notice(f"results: {out / 'results.json'}; tables: {out / 'tables'}")
    for capture in results.captures:
        picture = out / "captures" / capture.id / "pictures" / "comparison.png"
        if picture.is_file():
            notice(f"images: {picture}")
    return status


def _notice_failures(folder: Path, results: Results, head: str = "") -> int:
    """Say which frames failed; returns the exit status."""
    from hwp_bench.evaluation.sentences import failures, outcome_lines

    for line in outcome_lines(folder, results, head):
        notice(line)
    return int(any(failures(capture) for capture in results.captures))


def _evaluation_settings(args: argparse.Namespace) -> EvaluationSettings:
    """Return the settings that `_add_evaluation` and `--seed` gave."""
    from hwp_bench.evaluation.capture_evaluation import EvaluationSettings
    from hwp_bench.evaluation.evaluate import make_budget
    from hwp_bench.methods.contract import RunSettings
    from hwp_bench.run.sandbox.confinement import Confinement

    for name in ("budget", "steps", "time_limit"):
        value = getattr(args, name)
        if value is not None and not 0 < value < float("inf"):
            raise UsageError(f"{value} is not above 0", field=f"--{name.replace('_', '-')}")
    # From a byte to more than any machine has.
    if args.memory_limit is not None and not 1e-9 <= args.memory_limit <= 1e9:
        problem = f"{args.memory_limit:g} GB is not from 1e-9 to 1e9 GB"
        raise UsageError(problem, field="--memory-limit")
    if args.budget is not None and args.time_limit is not None and args.time_limit <= args.budget:
        problem = f"{args.time_limit:g} s end a fit of {args.budget:g} s"
        remedy = "Leave room for what is drawn after it, or leave out one of the two."
        raise UsageError(problem, field="--time-limit", remedy=remedy)
    budget = make_budget(args.budget, args.steps)
    return EvaluationSettings(
        suite="captures" if args.capture else args.suite,
        preset=args.preset,
        run=RunSettings(overrides(args.set), args.seed, budget, args.train_on),
        time_limit=args.time_limit,
        confinement=Confinement(
            mode=args.isolation,
            memory_limit=None if args.memory_limit is None else int(args.memory_limit * 1e9),
            # A machine of a cluster has another working folder.
            exposed=tuple(Path(path).absolute() for path in args.expose),
        ),
    )


_ABLATE = """examples:
  hwp-bench ablate --suite mini                          # DPD x PAO x pre-pass, three seeds
  hwp-bench ablate --only dpd pao                        # DPD x PAO
  hwp-bench ablate --no-dpd --no-pao                     # each out of the full method, and both
  hwp-bench ablate --without dpd pao heads               # each out of the full method, all out
  hwp-bench ablate --with binary-mask                    # a binary mask in place of PAO's weights
  hwp-bench ablate --only dpd pao heads                  # 2 x 2 x 2
  hwp-bench ablate --base paper                          # the paper's Table 6: no addition of ours
  hwp-bench ablate my_method --without loss --budget 60  # what a third party's method declares
  hwp-bench ablate --suite full --engine ray://10.0.0.1:6379 --job-gpus 1

Which variants are run:
  neither         the components that the method names for it, or else the first two that it
                  declares, crossed: 2^k
  --only A B ...  the named components, crossed: 2^k
  --without A B   the full method; each of the named components out of it; and all of them out
  --with A        the full method; the named alternative in place of what it does otherwise
The first row is the barest; a line says which components it keeps. --base NAME takes these out too.

Started again with the same arguments, it takes finished jobs as they are; results of other settings
are refused, or replaced at the end with --overwrite. Exit status 1: the method failed on a capture
or left out frames.
"""


def _add_ablate(parser: argparse.ArgumentParser) -> None:
    parser.epilog = _ABLATE
    add, text = parser.add_argument, "method directory or name (default wildghand)"
    add("method", metavar="METHOD", nargs="?", default="wildghand", help=text)
    text = "leave out components of method.toml, such as dpd, pao and heads of wildghand"
    add("--without", **SEVERAL, metavar="COMPONENT", help=text)
    for name in ("dpd", "pao"):
        text = f"the same as --without {name}"
        add(f"--no-{name}", dest="without", action="append_const", const=name, help=text)
    text = "use alternatives of method.toml, such as binary-mask of wildghand"
    add("--with", dest="alternatives", **SEVERAL, metavar="NAME", help=text)
    add("--only", **SEVERAL, metavar="COMPONENT", help="cross these components")
    text = "start from this simpler form that method.toml declares: wildghand has paper, released"
    add("--base", metavar="NAME", help=text)
    _add_evaluation(parser)
    add("--seeds", type=int, default=3, help="number of seeds (default 3)")
    add("-o", "--out", help="folder (default runs/ablation-METHOD-SUITE[-BASE])")
    add_json(parser, "print the record, ablation.json")


def _ablate(args: argparse.Namespace) -> int:
    from hwp_bench.evaluation.ablate.runs import make_design, run_ablation
    from hwp_bench.methods.manifest import check_settings, find_method, read_manifest

    _check_seeds(args.seeds)
    args.seed = 0
    settings = _evaluation_settings(args)
    # A wrong method, setting or switch must be reported before a suite is rendered for it.
    manifest = read_manifest(find_method(args.method))
    check_settings(manifest, settings.run.settings, "--set")
    design = make_design(manifest, [*args.without, *args.alternatives], args.only, args.base)
    based = f"-{args.base}" if args.base else ""
    out = Path(args.out or f"runs/ablation-{manifest.name}-{settings.suite}{based}")
    seeds = range(args.seeds)
    with _running(args, [Call(manifest, settings, out)]) as (captures, jobs, options):
        names = ", ".join(variant.name for variant in design.variants)
        notice(f"{len(design.variants)} variants: {names}")
        options["on_job"] = jobs.turn if jobs else None
        ablation = run_ablation(manifest, design, captures, out, settings, seeds, **options)
    return _report_ablate(ablation, out, as_json=args.json)


def _report_ablate(ablation: AblationRuns, out: Path, *, as_json: bool) -> int:
    from hwp_bench.analysis.pairing import common_metrics
    from hwp_bench.evaluation.ablate.effects import (
        PRINTED,
        ablation_record,
        ablation_tables,
        cost_effects,
        score_effects,
        write_record,
    )
    from hwp_bench.evaluation.ablate.runs import result_folder
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
        for name in PRINTED:
            if name in tables:
                print_table(tables[name])
    _draw_ablate(ablation, out)
    notice(f"record: {write_record(out, record)}; tables: {out / 'tables'}")
    say_next("hwp-bench", "report", out, "-o", Path("reports") / out.name)
    status = 0
    for name, runs in ablation.runs.items():
        for seed, result in runs.seeds.items():
            head = f"{result.method.title}, seed {seed}, "
            status |= _notice_failures(out / result_folder(name, seed), result, head)
    return status


def _draw_ablate(ablation: AblationRuns, out: Path) -> None:
    from hwp_bench.analysis.cost import analyse_cost
    from hwp_bench.report.figures import write_cost

    try:
        analysis = analyse_cost(list(ablation.runs.values()), "psnr")
    except UsageError as error:
        notice(f"no figure of accuracy against time: {error.problem}")
        return
    for figure in write_cost(out / "cost", analysis):
        notice(f"figure: {figure}")


_ERROR_BUDGET = """examples:
  hwp-bench error-budget wildghand --suite mini --budget 16 --jobs 2
  hwp-bench error-budget baselines/plain --capture my_capture
  hwp-bench error-budget my_method --capture capture4 --truths poses test-poses --json

Each truth that a simulated capture knows replaces one estimate (pixels, masks, poses, test-poses,
betas, mesh), then all of them do; the method is fitted each time. What a capture does not know is
left out: of a real one the corrections of the rendered test frames remain. Started again with the
same arguments, it takes finished captures as they are.
Exit status 1: the method failed on a capture or left out frames.
"""


def _add_error_budget(parser: argparse.ArgumentParser) -> None:
    parser.epilog = _ERROR_BUDGET
    add = parser.add_argument
    add("method", metavar="METHOD_DIR", help=METHOD_HELP)
    text = "estimates to replace by the truth (default: all that the captures have)"
    add("--truths", nargs="*", metavar="NAME", help=text)
    _add_evaluation(parser)
    add("-o", "--out", help="folder (default runs/error-budget-METHOD-SUITE)")
    add("--seed", type=int, default=0, help="seed of all random numbers")
    add_json(parser, "print the record, budget.json")


def _error_budget(args: argparse.Namespace) -> int:
    from hwp_bench.evaluation.budget.budget import check_oracle_inputs, run_budget
    from hwp_bench.methods.manifest import find_method, read_manifest
    from hwp_bench.methods.request import ORACLE_INPUTS, frame_choice

    settings = _evaluation_settings(args)
    manifest = read_manifest(find_method(args.method))
    truths = tuple(ORACLE_INPUTS) if args.truths is None else args.truths
    check_oracle_inputs(truths, settings)
    out = Path(args.out or f"runs/error-budget-{manifest.name}-{settings.suite}")
    # The call that asks for most.
    call = replace(settings, run=replace(settings.run, frames=frame_choice(truths)))
    with _running(args, [Call(manifest, call, out)]) as (captures, jobs, options):

        def on_run(index: int, count: int, name: str) -> OnCapture | None:
            notice(f"{index + 1} of {count}: {name}")
            return jobs.turn if jobs else None

        runs = run_budget(args.method, captures, out, settings, truths, on_run=on_run, **options)
    return _report_error_budget(runs, out, as_json=args.json)


def _report_error_budget(runs: BudgetRuns, out: Path, *, as_json: bool) -> int:
    from hwp_bench.base.files import write_json
    from hwp_bench.base.images import write_image
    from hwp_bench.evaluation.budget.budget import (
        budget_sheet,
        budget_tables,
        make_budget,
        next_work,
    )
    from hwp_bench.results.schema import add_isolation_note

    budget = make_budget(runs)
    evaluations = list(runs.results.values())
    found = budget_tables(budget)
    tables = {name: add_isolation_note(table, evaluations) for name, table in found.items()}
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
        status |= _notice_failures(runs.folders[name], results, f"{name}: ")
    return status


_DEMO = """examples:
  hwp-bench demo
  hwp-bench demo -o my-demo
  hwp-bench demo --methods plain my_method/

Renders the two captures of the smoke suite, fits the plain baseline and WildGHand to their
training frames, scores both on the test frames, prints the tables and the seconds of each step,
and draws truth and methods side by side. Needs no data and no network. Started again it takes
finished fits as they are.
"""


def _add_demo(parser: argparse.ArgumentParser) -> None:
    parser.epilog = _DEMO
    add = parser.add_argument
    add("-o", "--out", default="hwp-demo", help="folder to write (default hwp-demo)")
    text = "methods to run: directories or shipped names (default plain wildghand)"
    add("--methods", nargs="+", default=["plain", "wildghand"], metavar="METHOD", help=text)
    add_overwrite(parser, "results of other versions of the methods in the folder")


def _demo(args: argparse.Namespace) -> int:
    from hwp_bench.capture import open_capture
    from hwp_bench.evaluation.artifacts import write_side_by_side
    from hwp_bench.evaluation.capture_evaluation import EvaluationSettings
    from hwp_bench.evaluation.evaluate import check_call, check_results_place, check_suite, evaluate
    from hwp_bench.methods import find_method, read_manifest
    from hwp_bench.report.sources import ResultsSource
    from hwp_bench.report.tables import all_tables
    from hwp_bench.suites.suite import ensure_suite

    out, settings, replaces = Path(args.out), EvaluationSettings("smoke"), args.overwrite
    manifests = [read_manifest(find_method(method)) for method in args.methods]
    for manifest in manifests:
        check_results_place(manifest, out, {})
        check_call(manifest, settings, out / manifest.name, overwrite=replaces)
        check_suite(manifest, settings, out / manifest.name)
    laps: list[tuple[str, float]] = []
    start = time.perf_counter()
    captures = ensure_suite("smoke")
    laps.append(("simulated captures (rendered once, then cached)", time.perf_counter() - start))
    sources, status = [], 0
    for method, manifest in zip(args.methods, manifests, strict=True):
        start, folder = time.perf_counter(), out / manifest.name
        with JobsView() as jobs:
            results = evaluate(
                method, captures, folder, settings, on_capture=jobs.turn, overwrite=replaces
            )
        step = f"{results.method.title}: fit, render, score, pictures"
        laps.append((step, time.perf_counter() - start))
        sources.append(ResultsSource(results, folder))
        status = max(status, _report_outcome(folder, results))
    tables = all_tables([source.results for source in sources])
    write_tables(out / "tables", tables)
    print_table(tables["overall"])
    print_table(tables["captures"])
    columns = (Column("step"), Column("seconds", 1))
    print_table(Table("Time of this demo", columns, tuple(laps)))
    picture = out / "side-by-side.png"
    write_side_by_side(picture, sources, [open_capture(capture) for capture in captures])
    notice(f"truth and methods side by side: {picture}; tables: {out / 'tables'}")
    say_next("hwp-bench", "new", "my_method")
    return status


#: The arguments and the work of each command, where `main` looks for them.
COMMANDS = {
    "evaluate": (_add_evaluate, _evaluate),
    "ablate": (_add_ablate, _ablate),
    "error-budget": (_add_error_budget, _error_budget),
    "demo": (_add_demo, _demo),
}
