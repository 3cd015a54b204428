"""Evaluate a method on a set of captures: checks before any work, plans, the loop over captures.

Whatever is wrong with a call is reported before a suite is rendered for minutes (`check_call`,
`check_suite`).
"""

from __future__ import annotations

import datetime
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import TypedDict, Unpack

from hwp_bench.base.console import notice
from hwp_bench.base.errors import BadMethod, HwpError, UsageError, one_line
from hwp_bench.base.files import Places, canonical_json, check_places, inside
from hwp_bench.base.folders import exclusive
from hwp_bench.base.packages import __version__
from hwp_bench.base.records import check_json_values, merged, parse_record
from hwp_bench.capture import Capture
from hwp_bench.capture.splits import Split, split_for
from hwp_bench.commitments.publication import open_captures
from hwp_bench.evaluation.capture_evaluation import CaptureEvaluation, EvaluationSettings
from hwp_bench.evaluation.results_folder import (
    RESULTS,
    announce_kept,
    finish_together,
    open_results_folder,
    refuse_other,
)
from hwp_bench.methods.contents import digest_of, refuse_links_out
from hwp_bench.methods.contract import FRAME_CHOICES, Budget, RunSettings
from hwp_bench.methods.manifest import (
    DEFAULT_PRESET,
    MethodManifest,
    check_settings,
    find_method,
    find_setting_files,
    read_manifest,
)
from hwp_bench.methods.request import is_frame_choice
from hwp_bench.metrics import PROTOCOLS
from hwp_bench.metrics.lpips import load_available
from hwp_bench.metrics.score import Network
from hwp_bench.results import CaptureResult, MethodId, Results, write_results
from hwp_bench.results.schema import environment, lifted_steps
from hwp_bench.run.engine import Engine, LocalEngine, Needs
from hwp_bench.run.runner import rehearse_method
from hwp_bench.suites.suite import SuiteCapture, is_ready, suite

#: Most seconds that a method may take to be made before the first capture.
REHEARSAL_SECONDS = 600.0
#: Called when a capture's work begins, with (index, count, capture id); returns a function that is
#: then called with (done, total) steps.
OnCapture = Callable[[int, int, str], Callable[[int, int], None] | None]


class How(TypedDict, total=False):
    """How the captures of a command are worked on; nothing of it decides a score."""

    #: Where jobs run; without it in this process.
    engine: Engine | None
    #: The share of a machine that each job takes.
    needs: Needs | None
    #: Whether results of another evaluation are replaced, once all new ones are whole.
    overwrite: bool
    #: Whether the method is made once before the first capture.
    rehearse: bool


def make_budget(seconds: float | None, steps: int | None) -> Budget:
    """Return the budget that a person asks for; seconds alone lift the method's limit of steps.

    They stand next to more steps than a fit takes in that time (`lifted_steps`), so that a result
    says what it was made with.
    """
    asked = Budget(seconds, steps)
    if asked.seconds is None or asked.steps is not None:
        return asked
    return replace(asked, steps=lifted_steps(asked.seconds))


def default_folder(method: str, settings: EvaluationSettings) -> Path:
    """Return the results folder of an evaluation that names none.

    Oracles, budgets and seeds other than 0 have folders of their own.
    """
    run = settings.run
    lifted = run.budget == make_budget(run.budget.seconds, None)
    parts = [Path(method).name or Path(method).resolve().name, settings.suite]
    parts += [] if run.frames == FRAME_CHOICES[0] else [run.frames]
    parts += [] if run.budget.seconds is None else [f"{run.budget.seconds:g}s"]
    parts += [] if run.budget.steps is None or lifted else [f"{run.budget.steps}steps"]
    parts += [] if run.seed == 0 else [f"seed{run.seed}"]
    return Path("runs") / "-".join(parts)


def evaluate(
    method: str,
    captures: Sequence[Path],
    out: Path,
    settings: EvaluationSettings,
    *,
    splits: Mapping[str, Split] | None = None,
    on_capture: OnCapture | None = None,
    **how: Unpack[How],
) -> Results:
    """Evaluate a method; `run_plans` says what becomes of results that are there.

    `splits` go by capture id; None applies the 80/10/10 rule. `out/results.json` then holds the
    results, `out/tables` their tables.
    """
    manifest = read_manifest(find_method(method))
    settings = with_setting_files(manifest, settings)
    plan = make_plan(manifest, open_captures(captures, splits), settings)
    order = [("", place) for place in range(len(plan.evaluations))]
    return run_plans(out, {"": plan}, order, on_start=on_capture, **how)[""]


def run_plans(
    out: Path,
    plans: Mapping[str, Plan],
    order: Sequence[tuple[str, int]],
    *,
    on_start: OnCapture | None,
    tables: bool = True,
    **how: Unpack[How],
) -> dict[str, Results]:
    """Run what is missing of some plans, each in a folder below `out`, with the lock of `out`.

    A capture's result is on disk before the next begins. Results of the same key are taken as they
    are, with a message; results of another evaluation are refused, or stay until all new ones
    are whole (`overwrite`).
    """
    with exclusive(out):
        for evaluation in next(iter(plans.values())).evaluations:
            if evaluation.capture.lacks_masks:
                name = evaluation.capture.info.id
                notice(f"{name}: its true masks are not there: scored on its estimated masks")
        _warn_of_training(next(iter(plans.values())))
        folders = {
            name: open_results_folder(
                out / name,
                plan.results([]),
                plan.evaluations,
                overwrite=how.get("overwrite", False),
            )
            for name, plan in plans.items()
        }
        announce_kept(list(folders.values()))
        found = {name: dict(folder.kept) for name, folder in folders.items()}
        missing = [(name, place) for name, place in order if place not in found[name]]
        if how.get("rehearse"):
            # Plans that differ in their seeds alone are made once.
            first = {
                canonical_json(plans[name].settings.run.settings): plans[name]
                for name, _ in missing
            }
            for plan in first.values():
                plan.rehearse()
        jobs, needs = [], how.get("needs") or Needs()
        for name, place in missing:
            evaluation = plans[name].evaluations[place].hiding(out)
            text = ", ".join(filter(None, (evaluation.capture.info.id, plans[name].title)))
            jobs.append(evaluation.job(folders[name].unfinished(place), text, needs))

        def record(name: str) -> Results:
            # By place, so that a record lists captures in one order whichever ended first.
            return plans[name].results([result for _, result in sorted(found[name].items())])

        def on_done(index: int) -> None:
            name, place = missing[index]
            found[name][place] = folders[name].finish(place)
            if not tables and not folders[name].replaces:
                write_results(folders[name].root / RESULTS, record(name))

        (how.get("engine") or LocalEngine()).run(jobs, on_done, on_start)
        ran = {name for name, _ in missing}
        results = {
            name: record(name) if name in ran else folders[name].as_it_was(record(name))
            for name in plans
        }
        finish_together([(folders[name], results[name]) for name in plans], tables=tables)
        return results


def _warn_of_training(plan: Plan) -> None:
    """Say which captures a method learnt from before, as it declares itself."""
    infos = [evaluation.capture.info for evaluation in plan.evaluations]
    scenes = {info.id: str(info.source.get("scene_digest") or info.origin) for info in infos}
    if shared := plan.manifest.training.shared(scenes):
        notice(
            f"warning: {plan.manifest.name} declares that it was trained on {', '.join(shared)}, "
            "on which it is scored now: the leaderboard refuses such results"
        )


def with_setting_files(
    manifest: MethodManifest, settings: EvaluationSettings
) -> EvaluationSettings:
    """Expose the files that a person's settings name, with absolute paths in the settings."""
    chosen, files = find_setting_files(manifest, settings.run.settings)
    exposed = tuple(dict.fromkeys((*settings.confinement.exposed, *files)))
    return replace(
        settings,
        run=replace(settings.run, settings=chosen),
        confinement=replace(settings.confinement, exposed=exposed),
    )


@dataclass(frozen=True)
class Plan:
    """A method with its settings on every capture; `evaluate_capture` runs one of them."""

    manifest: MethodManifest
    #: How it is evaluated: the preset that is taken, and all settings of the method.
    settings: EvaluationSettings
    #: One for each capture.
    evaluations: tuple[CaptureEvaluation, ...]
    #: When the plan was made, ISO 8601, UTC.
    started: str
    #: Digest of the method when the plan was made.
    digest: str
    #: What tells it from other plans of one command; empty where there is one.
    title: str = ""

    def rehearse(self) -> None:
        """Make the method once with its settings: what fails there would fail on every capture."""
        settings = self.settings
        rehearse_method(
            self.manifest,
            settings.run,
            time_limit=min(settings.killed_after, REHEARSAL_SECONDS),
            confinement=settings.confinement,
        )

    def results(self, finished: Sequence[CaptureResult]) -> Results:
        """Return the record of the captures that are finished."""
        name, title, run = self.manifest.name, one_line(self.manifest.title), self.settings.run
        return Results(
            method=MethodId(
                name,
                title,
                self.digest,
                self.settings.preset or DEFAULT_PRESET,
                dict(run.settings),
                self.manifest.training,
                self.manifest.validation,
            ),
            suite=self.settings.suite,
            seed=run.seed,
            budget={"seconds": run.budget.seconds, "steps": run.budget.steps},
            frames=run.frames,
            protocols={protocol.name: protocol.as_dict() for protocol in PROTOCOLS},
            environment=environment(),
            started=self.started,
            captures=list(finished),
            toolkit=__version__,
        )


def make_plan(
    manifest: MethodManifest,
    captures: Sequence[tuple[Capture, Split]],
    settings: EvaluationSettings,
    networks: Mapping[str, Network] | None = None,
    title: str = "",
) -> Plan:
    """Plan an evaluation; nothing runs yet. `networks` None loads those whose weights are there."""
    preset = manifest.preset(settings.preset, settings.suite)
    check_json_values(
        dict(settings.run.settings), where=manifest.name, field="settings", error=BadMethod
    )
    manifest.check_setting_names(settings.run.settings)
    chosen = merged(manifest.presets.get(preset, {}), settings.run.settings)
    settings = replace(settings, preset=preset, run=replace(settings.run, settings=chosen))
    refuse_links_out(manifest.root, settings.confinement.exposed)
    files = manifest.contents
    networks = load_available() if networks is None else networks
    evaluations = tuple(
        CaptureEvaluation(manifest, capture, split, settings, networks, files)
        for capture, split in captures
    )
    started = datetime.datetime.now(datetime.UTC).isoformat(timespec="seconds")
    plan = Plan(manifest, settings, evaluations, started, digest_of(files), title)
    # Before anything runs: what is to be written will have to be read.
    head = asdict(plan.results([]))
    parse_record(Results, head, where=manifest.name, error=BadMethod)
    return plan


def check_results_place(
    manifest: MethodManifest, out: Path, inputs: Mapping[str, Places], option: str = "--out"
) -> None:
    """Refuse results that would lie in the method or in data, or replace data.

    A method could read results in its own folder, and they would change its digest.
    """
    check_places({option: out}, {"METHOD_DIR": manifest.root, **inputs})
    check_places({f"{option}, captures": out / "captures"}, inputs, replaces=True)


def check_call(
    manifest: MethodManifest,
    settings: EvaluationSettings,
    out: Path,
    field: str = "settings",
    *,
    overwrite: bool = False,
) -> None:
    """Refuse a call that cannot work, where the call alone shows it."""
    _refuse_without_effect(manifest, settings.run)
    check_settings(manifest, settings.run.settings, field)
    manifest.preset(settings.preset, settings.suite)
    if not is_frame_choice(settings.run.frames):
        known = ", ".join(FRAME_CHOICES)
        raise UsageError(f"{settings.run.frames!r} is not one of {known}", field="frames")
    for path in settings.confinement.exposed:
        if not path.exists():
            raise UsageError("does not exist", where=path, field="--expose")
    above = next((place for place in (out, *out.absolute().parents) if place.exists()), out)
    if above.exists() and not above.is_dir():
        raise HwpError(
            "cannot be a results folder, because a file is there",
            where=above,
            remedy="Choose another folder with --out.",
        )
    if not overwrite:
        plan = make_plan(manifest, (), with_setting_files(manifest, settings), {})
        refuse_other(out, plan.results([]))


def _refuse_without_effect(manifest: MethodManifest, run: RunSettings) -> None:
    """Refuse what a result would record of pictures though they were drawn without it.

    A budget is let through: it says what they were drawn with.
    """
    if manifest.kind != "predictions":
        return
    given = {
        "a seed other than 0": run.seed != 0,
        "a limit of steps": run.budget != make_budget(run.budget.seconds, None),
        "settings": bool(run.settings),
        "an oracle": run.frames != FRAME_CHOICES[0],
    }
    for name, there in given.items():
        if there:
            raise UsageError(
                f"holds pictures that were drawn before: {name} would have no effect",
                where=manifest.root,
                remedy="Leave it out.",
            )


def check_suite(
    manifest: MethodManifest,
    settings: EvaluationSettings,
    out: Path,
    splits: Mapping[str, Split] | None = None,
    *,
    rehearse: bool = True,
) -> bool:
    """Refuse what would fail on a suite, before it is rendered or imported."""
    items = suite(settings.suite)
    for item in items:
        split_for(item.id, item.frame_count, splits)
    if manifest.kind == "predictions":
        _check_predictions(manifest, items)
    if is_ready(settings.suite):
        return False
    if rehearse:
        make_plan(manifest, (), with_setting_files(manifest, settings), {}).rehearse()
    with exclusive(out):
        pass
    return rehearse


def _check_predictions(manifest: MethodManifest, items: Sequence[SuiteCapture]) -> None:
    names = [item.id for item in items]
    folders = {
        name: inside(manifest.root, f"{manifest.entry.predictions}/{name}") for name in names
    }
    missing = [name for name, folder in folders.items() if not any(folder.glob("*.png"))]
    if len(missing) == len(names):
        raise BadMethod(
            f"has predictions of no capture of this suite ({', '.join(names)})",
            where=manifest.root / str(manifest.entry.predictions),
            remedy=f"Put the frames into {manifest.entry.predictions}/CAPTURE/, or choose another "
            "suite.",
        )
    if missing:
        notice(f"no predictions of {', '.join(missing)}: every frame there gets the penalty")
