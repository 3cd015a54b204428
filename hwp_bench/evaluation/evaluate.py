"""Evaluate a method on a set of captures."""

from __future__ import annotations

import datetime
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path

from hwp_bench.base.console import notice
from hwp_bench.base.errors import BadCapture, BadMethod, one_line
from hwp_bench.base.folders import exclusive
from hwp_bench.base.packages import __version__
from hwp_bench.base.records import check_json_values, merged, parse_record
from hwp_bench.capture import Capture, open_capture
from hwp_bench.capture.splits import Split, split_for
from hwp_bench.evaluation.capture_evaluation import (
    CaptureEvaluation,
    evaluation_job,
)
from hwp_bench.evaluation.results_folder import (
    finish_together,
    open_results_folder,
    say_kept,
)
from hwp_bench.methods.contents import digest_of, method_files, refuse_links_out
from hwp_bench.methods.contract import FRAME_CHOICES, RunSettings
from hwp_bench.methods.manifest import MethodManifest, find_method, read_manifest
from hwp_bench.methods.setting_files import find_setting_files
from hwp_bench.metrics import PROTOCOLS
from hwp_bench.metrics.lpips import load_available
from hwp_bench.metrics.score import Network
from hwp_bench.results import CaptureResult, MethodId, Results
from hwp_bench.results.environment import environment
from hwp_bench.run.engine import Engine, LocalEngine, Needs
from hwp_bench.run.runner import DEFAULT_TIME_LIMIT, rehearse_method
from hwp_bench.run.sandbox.confinement import Confinement

#: Most seconds that a method may take to be made before the first capture.
REHEARSAL_SECONDS = 600.0
#: Called when a capture's work begins, with (index, count, capture id); returns a function that is
#: then called with (done, total) steps.
OnCapture = Callable[[int, int, str], Callable[[int, int], None] | None]


@dataclass(frozen=True)
class EvaluationSettings:
    """How a method is evaluated."""

    #: Name of the suite, for the record and as the name of the preset that fits it.
    suite: str = "captures"
    #: Preset of the method; None takes the one named like the suite, else `default`.
    preset: str | None = None
    #: Single settings that override the preset, seed, budget and training frames.
    run: RunSettings = field(default_factory=RunSettings)
    #: Seconds after which a method is killed on one capture.
    time_limit: float = DEFAULT_TIME_LIMIT
    #: How its process is confined, and its memory limit.
    confinement: Confinement = field(default_factory=Confinement)


def default_folder(method: str, settings: EvaluationSettings) -> Path:
    """Return the results folder of an evaluation that names none.

    Oracles, budgets and seeds other than 0 have folders of their own.
    """
    run = settings.run
    parts = [Path(method).name or Path(method).resolve().name, settings.suite]
    parts += [] if run.frames == FRAME_CHOICES[0] else [run.frames]
    parts += [] if run.budget.seconds is None else [f"{run.budget.seconds:g}s"]
    parts += [] if run.budget.steps is None else [f"{run.budget.steps}steps"]
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
    engine: Engine | None = None,
    needs: Needs | None = None,
    overwrite: bool = False,
    rehearse: bool = False,
) -> Results:
    """Evaluate a method.

    Every capture is opened and checked before the method runs on the first one. A capture's
    result is on disk before the next begins, and an evaluation that is started again takes
    finished captures as they are, and says so. Results of another evaluation that `out` holds are
    refused, or stay until all new ones are whole.

    Args:
        method: method directory, or the name of one that ships with the toolkit.
        captures: capture folders.
        out: results folder.
        settings: suite, preset, seed, budget, limits.
        splits: splits by capture id; None applies the 80/10/10 rule.
        on_capture: hook for showing progress, where captures are evaluated in turn.
        engine: where captures are evaluated; one after another in this process if None.
        needs: the share of a machine that one capture takes.
        overwrite: results of another evaluation in `out` may be replaced.
        rehearse: make the method once before the first capture, where any is to be run; not to be
            asked for where it runs on other machines.

    Returns:
        The results, which `out/results.json` then holds, with tables in `out/tables`.

    Raises:
        UsageError: `out` holds results of another evaluation.
        BadMethod: the method directory is wrong, or its files change meanwhile.
        MethodFailed: the method cannot be made.
        BadCapture, BadInput, BadImage, BadSplit: a capture is wrong.
        HwpError: another evaluation is writing to `out`, or it cannot be written.
    """
    manifest = read_manifest(find_method(method))
    settings = with_setting_files(manifest, settings)
    plan = make_plan(manifest, open_captures(captures, splits), settings)
    with exclusive(out):
        return _evaluate(
            plan, out, engine, needs, on_capture, overwrite=overwrite, rehearse=rehearse
        )


def _evaluate(
    plan: Plan,
    out: Path,
    engine: Engine | None,
    needs: Needs | None,
    on_capture: OnCapture | None,
    *,
    overwrite: bool,
    rehearse: bool,
) -> Results:
    """Run what is missing of a plan, with the lock of its folder."""
    for evaluation in plan.evaluations:
        if evaluation.capture.lacks_masks:
            name = evaluation.capture.info.id
            notice(f"{name}: its true masks are not there: scored on its estimated masks")
    folder = open_results_folder(out, plan.results([]), plan.evaluations, overwrite=overwrite)
    say_kept([folder])
    missing, found = folder.missing, dict(folder.kept)
    if rehearse and missing:
        plan.rehearse()
    jobs = []
    for place in missing:
        evaluation = hiding(plan.evaluations[place], out)
        text = evaluation.capture.info.id
        jobs.append(evaluation_job(evaluation, folder.unfinished(place), text, needs or Needs()))

    def on_done(index: int) -> None:
        found[missing[index]] = folder.finish(missing[index])

    (engine or LocalEngine()).run(jobs, on_done, on_capture)
    results = plan.results([found[place] for place in range(len(plan.evaluations))])
    finish_together([(folder, results)], tables=True)
    return results


def hiding(evaluation: CaptureEvaluation, out: Path) -> CaptureEvaluation:
    """Return an evaluation whose method does not see a results folder, with its test frames."""
    confinement = evaluation.confinement
    hidden = (*confinement.hidden, out.absolute())
    return replace(evaluation, confinement=replace(confinement, hidden=hidden))


def with_setting_files(
    manifest: MethodManifest, settings: EvaluationSettings
) -> EvaluationSettings:
    """Expose the files that a person's settings name, with absolute paths in the settings.

    Raises:
        UsageError: one of them is not there.
    """
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

    #: The method.
    manifest: MethodManifest
    #: Name of the suite.
    suite: str
    #: Name of the preset that is taken.
    preset: str
    #: The preset with its overrides, seed, budget and training frames.
    run: RunSettings
    #: One for each capture.
    evaluations: tuple[CaptureEvaluation, ...]
    #: When the plan was made, ISO 8601, UTC.
    started: str
    #: Digest of the method when the plan was made.
    digest: str
    #: Seconds after which a method is stopped, and how it is confined.
    time_limit: float
    confinement: Confinement

    def rehearse(self) -> None:
        """Make the method once with its settings: what fails there would fail on every capture.

        Raises:
            MethodFailed: it cannot be made; its last lines have been printed.
            BadMethod: there is no such program.
        """
        limit = min(self.time_limit, REHEARSAL_SECONDS)
        rehearse_method(self.manifest, self.run, time_limit=limit, confinement=self.confinement)

    def results(self, finished: Sequence[CaptureResult]) -> Results:
        """Return the record of the captures that are finished."""
        manifest, run = self.manifest, self.run
        return Results(
            method=MethodId(
                manifest.name,
                one_line(manifest.title),
                self.digest,
                self.preset,
                dict(run.settings),
            ),
            suite=self.suite,
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
) -> Plan:
    """Plan an evaluation; nothing runs yet.

    Args:
        manifest: the method.
        captures: what `open_captures` returned.
        settings: suite, preset, seed, budget, limits.
        networks: LPIPS by backbone; None loads those whose weights are there.

    Raises:
        BadMethod: there is no such preset, or an override is not a plain value or not a setting
            of the method, or the result could not be read again, or the method has a link to what
            is in no digest.
    """
    preset = manifest.preset(settings.preset, settings.suite)
    check_json_values(
        dict(settings.run.settings), where=manifest.name, field="settings", error=BadMethod
    )
    manifest.check_setting_names(settings.run.settings)
    chosen = merged(manifest.presets.get(preset, {}), settings.run.settings)
    run = replace(settings.run, settings=chosen)
    refuse_links_out(manifest.root, settings.confinement.exposed)
    files = method_files(manifest.root)
    known = load_available() if networks is None else networks
    evaluations = tuple(
        CaptureEvaluation(
            manifest, capture, split, run, settings.time_limit, settings.confinement, known, files
        )
        for capture, split in captures
    )
    started = datetime.datetime.now(datetime.UTC).isoformat(timespec="seconds")
    plan = Plan(
        manifest,
        settings.suite,
        preset,
        run,
        evaluations,
        started,
        digest_of(files),
        settings.time_limit,
        settings.confinement,
    )
    # Before anything runs: what is to be written will have to be read.
    head = asdict(plan.results([]))
    parse_record(Results, head, where=manifest.name, error=BadMethod)
    return plan


def open_captures(
    paths: Sequence[Path], splits: Mapping[str, Split] | None = None
) -> list[tuple[Capture, Split]]:
    """Open captures, each with its split.

    Args:
        paths: capture folders.
        splits: splits by capture id; None applies the 80/10/10 rule.

    Raises:
        BadCapture, BadInput, BadImage, BadSplit: a capture is wrong, or two have one id.
    """
    opened: list[tuple[Capture, Split]] = []
    for path in paths:
        capture = open_capture(path)
        if any(other.info.id == capture.info.id for other, _ in opened):
            raise BadCapture(
                f"another capture has the id {capture.info.id!r} too",
                where=path,
                field="id",
                remedy="Evaluate them one by one, each into its own folder.",
            )
        opened.append((capture, split_for(capture.info.id, len(capture), splits)))
    return opened
