"""Evaluate one method on one capture: run it, score its predictions, store the result."""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Any

from hwp_bench.base.errors import BadMethod, HwpError, MethodFailed, bounded, one_line, shown
from hwp_bench.base.files import disc_errors, read_json, sha256_json, write_json
from hwp_bench.base.folders import remove_tree, scratch_folder
from hwp_bench.base.packages import PACKAGES
from hwp_bench.base.records import MAX_TEXT, parse_record
from hwp_bench.capture import Capture, open_capture
from hwp_bench.capture.check import refuse_changed
from hwp_bench.capture.schema import EXTRA, IMAGE_FOLDERS
from hwp_bench.capture.splits import Split
from hwp_bench.evaluation.artifacts import keep_artifacts
from hwp_bench.evaluation.scoring import (
    WARNINGS,
    colour_warnings,
    read_prediction,
    read_scorable,
    read_targets,
    score_frames_of,
)
from hwp_bench.methods.contents import digest_of, exposed_digest
from hwp_bench.methods.contract import FRAME_CHOICES, RunSettings
from hwp_bench.methods.manifest import MethodManifest, read_manifest, ships
from hwp_bench.methods.request import write_request
from hwp_bench.metrics import METRICS, PROTOCOLS
from hwp_bench.metrics.lpips import load_available
from hwp_bench.metrics.score import Network, mean_scores
from hwp_bench.results import CaptureResult, CurvePoint, FreeViewResult, Results
from hwp_bench.results.schema import ISOLATED
from hwp_bench.run.engine import Folder, Job, Needs
from hwp_bench.run.engine.job import OnProgress, ignore_progress
from hwp_bench.run.runner import DEFAULT_TIME_LIMIT, RunRecord, run_method
from hwp_bench.run.sandbox.confinement import Confinement, hand_model_files
from hwp_bench.run.worker import LOG, RunFacts, checkpoint_folder

#: Version of the evaluation itself; a stored result of another version is not taken.
RECIPE = 1
#: The result of one capture, inside its folder.
RESULT = "result.json"
# What a result repeats of a run's facts.
_FACTS = (
    *("fit_seconds", "render_seconds", "curve_seconds", "cpu_seconds"),
    *("steps", "peak_memory"),
)


@dataclass(frozen=True)
class EvaluationSettings:
    """How a method is evaluated."""

    #: Name of the suite, for the record and as the name of the preset that fits it.
    suite: str = "captures"
    #: Preset of the method; None takes the one named like the suite, else `default`.
    preset: str | None = None
    #: Single settings that override the preset, seed, budget and training frames.
    run: RunSettings = field(default_factory=RunSettings)
    #: Seconds after which a method is killed on one capture; None: an hour more than its budget.
    time_limit: float | None = None
    #: How its process is confined, and its memory limit.
    confinement: Confinement = field(default_factory=Confinement)

    @property
    def killed_after(self) -> float:
        """Seconds after which a method is killed on one capture."""
        if self.time_limit is not None:
            return self.time_limit
        return DEFAULT_TIME_LIMIT + (self.run.budget.seconds or 0.0)


@dataclass(frozen=True)
class CaptureEvaluation:
    """One method on one capture."""

    manifest: MethodManifest
    capture: Capture
    split: Split
    #: How it is evaluated, with all settings of the method.
    settings: EvaluationSettings
    #: LPIPS by backbone, where the weights are there, and FLIP.
    networks: Mapping[str, Network] = field(default_factory=dict)
    #: Digests of the method's files when the evaluation was planned; None takes them as they are.
    method_files: Mapping[str, str] | None = None

    @property
    def exposed(self) -> str | None:
        """Digest (hex) of the files that the method is shown next to its request, if any."""
        exposed = self.settings.confinement.exposed
        return exposed_digest(exposed) if exposed else None

    @property
    def key(self) -> str:
        """Digest (hex) of everything that decides the scores."""
        planned, clip, run = self.method_files, self.capture.free_view, self.settings.run
        method = self.manifest.digest if planned is None else digest_of(planned)
        return _key(
            method=(self.manifest.name, method),
            capture=self.capture.digest,
            split=self.split.digest,
            settings=dict(run.settings),
            seed=run.seed,
            budget=asdict(run.budget),
            frames=run.frames,
            protocols=[protocol.as_dict() for protocol in PROTOCOLS],
            networks=sorted(self.networks),
            exposed=self.exposed,
            free_view=None if clip is None else clip.digest,
        )

    def hiding(self, folder: Path) -> CaptureEvaluation:
        """Return the same where the method does not see a results folder, with its test frames."""
        confinement = self.settings.confinement
        confinement = replace(confinement, hidden=(*confinement.hidden, folder.absolute()))
        return replace(self, settings=replace(self.settings, confinement=confinement))

    def job(self, folder: Path, text: str, needs: Needs) -> Job:
        """Return it as a job of an engine, which shows the text; its result goes to the folder.

        Another process or machine opens method and capture itself.
        """
        root = self.manifest.root.resolve()
        # An installed method may lie next to our packages, but is not a part of them.
        shipped = root.relative_to(PACKAGES).as_posix() if ships(root) else None
        inputs = {"capture": Folder(self.capture.root, (EXTRA,))}
        if shipped is None:
            inputs["method"] = Folder(root)
        same = (self.split, self.settings)
        return Job(
            text=text,
            here=partial(evaluate_capture, self, folder),
            work=partial(evaluate_elsewhere, same, sorted(self.networks), shipped, self.key),
            output=folder,
            finished=lambda: stored_result(self, folder) is not None,
            inputs=inputs,
            needs=needs,
        )


def evaluate_capture(
    evaluation: CaptureEvaluation, folder: Path, on_progress: OnProgress = ignore_progress
) -> CaptureResult:
    """Run a method on a capture and score it; a stored result of the same key is taken as it is."""
    stored = stored_result(evaluation, folder)
    if stored is not None:
        return stored
    with disc_errors(folder):
        return _evaluate(evaluation, folder, on_progress)


def _evaluate(
    evaluation: CaptureEvaluation, folder: Path, on_progress: OnProgress
) -> CaptureResult:
    """Run and score, with no regard to a stored result; see `evaluate_capture`."""
    began = time.perf_counter()
    capture, clip = evaluation.capture, evaluation.capture.free_view
    targets = read_targets(capture, evaluation.split.test.tolist())
    free_targets = [] if clip is None else read_targets(clip, range(len(clip)))
    _refuse_changed(evaluation)
    remove_tree(folder)
    folder.mkdir(parents=True)
    output, kind = folder / "run", evaluation.manifest.kind
    entered = time.perf_counter()
    record, failure = _run(evaluation, output, on_progress)
    wall = 0.0 if kind == "predictions" else time.perf_counter() - entered
    _refuse_edited(evaluation)
    # A run that failed left nothing that would be scored. Our worker would have drawn the clip;
    # whether others offer views of it is not known.
    lost = output / "none" if kind == "python" else None
    record = record or RunRecord(output / "none", RunFacts(), wall, free_view=lost)
    started = time.perf_counter()
    scored = score_frames_of(targets, record.predictions, capture.size, evaluation.networks)
    score_seconds = time.perf_counter() - started
    free = None
    # Of a submission without views of the clip nothing is scored there.
    if clip is not None and record.free_view is not None:
        free = score_frames_of(free_targets, record.free_view, clip.size, evaluation.networks)
    facts = record.facts
    result = CaptureResult(
        id=capture.info.id,
        digest=capture.digest,
        hands=capture.info.hands,
        perturbations=list(capture.info.perturbations),
        split_digest=evaluation.split.digest,
        exact_masks=all(target.exact for target in targets),
        key=evaluation.key,
        frames=scored.scores,
        failure=None if failure is None else shown(failure)[:MAX_TEXT],
        predictions_digest=scored.digest,
        score_seconds=score_seconds,
        wall_seconds=record.wall_seconds,
        device=one_line(facts.device, 100) if facts.device else None,
        curve=_curve(evaluation, output, facts),
        **{name: getattr(facts, name) for name in _FACTS},
        isolation=one_line(record.isolation) if record.isolation else None,
        free_view=FreeViewResult(clip.digest, free.scores, free.digest) if clip and free else None,
        made_by=capture.info.made_by,
        origin=capture.info.origin,
        exposed=evaluation.exposed,
    )
    warnings = colour_warnings(targets, scored.predictions)
    if warnings:
        write_json(folder / WARNINGS, warnings)
    keep_artifacts(folder, output, scored, free)
    result = replace(result, job_seconds=time.perf_counter() - began)
    write_json(folder / RESULT, asdict(result))
    return result


def _run(
    evaluation: CaptureEvaluation, output: Path, on_progress: OnProgress
) -> tuple[RunRecord | None, str | None]:
    """Run the method on a copy of what it may see; returns the record, or why it failed."""
    settings = evaluation.settings
    with scratch_folder("hwp-request-") as temporary:
        request = temporary / "request"
        try:
            if evaluation.manifest.kind != "predictions":
                write_request(
                    request, evaluation.capture, evaluation.split, evaluation.settings.run
                )
            record = run_method(
                evaluation.manifest,
                evaluation.capture.info.id,
                request,
                output,
                time_limit=settings.killed_after,
                confinement=_confinement(evaluation, output),
                on_progress=on_progress,
            )
        except (MethodFailed, BadMethod) as error:
            return None, _lasting(error, output)
    if record.shortage is not None and _lacks_images(evaluation, record, output):
        # A method is not to be marked down for it, nor is the next start to keep it.
        return None, (
            f"images are missing or damaged, and {record.shortage}. Make room and start again "
            "with the same arguments: this capture is then evaluated again"
        )
    return record, None


def _confinement(evaluation: CaptureEvaluation, output: Path) -> Confinement:
    """Hide what holds test frames: the capture, and results next to the run."""
    asked = evaluation.settings.confinement
    hands = hand_model_files(evaluation.capture.info.hand_model.source)
    hidden = (*asked.hidden, evaluation.capture.root, output.parent.parent)
    return replace(asked, exposed=(*asked.exposed, *hands), hidden=hidden)


def _curve(evaluation: CaptureEvaluation, output: Path, facts: RunFacts) -> list[CurvePoint]:
    validation = set(evaluation.split.validation.tolist())
    frames = [frame for frame in dict.fromkeys(facts.checkpoint_frames) if frame in validation]
    # A validation frame without a hand has no score, which must not cost a whole fit.
    targets = read_scorable(evaluation.capture, frames)
    curve: list[CurvePoint] = []
    if not targets:
        return curve
    for index, checkpoint in enumerate(facts.checkpoints):
        drawn = score_frames_of(targets, checkpoint_folder(output, index), evaluation.capture.size)
        scores = mean_scores(frame.scores for frame in drawn.scores)
        curve.append(CurvePoint(**asdict(checkpoint), scores=scores))
    return curve


def _lacks_images(evaluation: CaptureEvaluation, record: RunRecord, output: Path) -> bool:
    """Whether an image that a run should have left is missing or damaged."""
    capture, clip = evaluation.capture, evaluation.capture.free_view
    folders = [checkpoint_folder(output, index) for index in range(len(record.facts.checkpoints))]
    wanted = [(folder, record.facts.checkpoint_frames, capture.size) for folder in folders]
    wanted.append((record.predictions, evaluation.split.test.tolist(), capture.size))
    if clip is not None and record.free_view is not None:
        wanted.append((record.free_view, list(range(len(clip))), clip.size))
    return any(
        read_prediction(folder, frame, size).failure is not None
        for folder, frames, size in wanted
        for frame in frames
    )


def _lasting(error: HwpError, output: Path) -> str:
    """Return an error's text for the result, which outlives the folder of the run.

    The log moves next to `result.json`, and the result may be read on another machine: a path
    into the run's folder would lead nowhere.
    """
    if error.where is None or not Path(error.where).is_relative_to(output):
        return str(error)
    log = f"{LOG} next to {RESULT} holds what it printed."
    advice = " ".join(text for text in (error.remedy, log) if text)
    return str(HwpError(error.problem, field=error.field, remedy=advice))


def _refuse_edited(evaluation: CaptureEvaluation) -> None:
    """Refuse to score a run of a method whose files are not those that it began with."""
    planned = evaluation.method_files
    if planned is None:
        return
    found = evaluation.manifest.contents
    changed = sorted(name for name in {*planned, *found} if planned.get(name) != found.get(name))
    if changed:
        raise BadMethod(
            f"files changed while it ran, so that nobody could say what was scored: "
            f"{shown(bounded(changed, 5))}",
            where=evaluation.manifest.root,
            remedy="Leave them alone meanwhile, and let the method write to its output folder "
            "alone. Started again, what is finished stays.",
        )


def _refuse_changed(evaluation: CaptureEvaluation) -> None:
    """Refuse a capture, or a clip in it, whose content is not that of the digests."""
    clean = evaluation.settings.run.frames != FRAME_CHOICES[0]
    for capture in (evaluation.capture, evaluation.capture.free_view):
        if capture is None:
            continue
        kinds = ["frames", "masks"]
        kinds += ["true_masks"] if capture.has_true_masks else []
        kinds += ["clean", "clean_masks"] if clean and capture.has_clean else []
        there = [kind for kind in kinds if (capture.root / IMAGE_FOLDERS[kind]).is_dir()]
        refuse_changed(capture, there)


# --- stored results


def stored_result(evaluation: CaptureEvaluation, folder: Path) -> CaptureResult | None:
    """Return the stored result of the same key, if there is one and the method did not fail.

    Where a sandbox is required, a result that was made without one does not count.
    """
    # Submitted predictions may change without their method.toml, so they are always scored.
    if not (folder / RESULT).is_file() or evaluation.manifest.kind == "predictions":
        return None
    try:
        result = read_result(folder)
    except HwpError:
        return None
    if evaluation.settings.confinement.mode == "required" and result.isolation != ISOLATED:
        return None
    return result if result.key == evaluation.key and result.failure is None else None


def read_result(folder: Path) -> CaptureResult:
    """Read the result that `evaluate_capture` left in a folder."""
    path = folder / RESULT
    return parse_record(CaptureResult, read_json(path), where=str(path))


# --- the key


def _key(*, exposed: str | None, free_view: str | None, **content: Any) -> str:
    """Return the SHA-256 (hex) of everything that decides the scores of a capture.

    A stored result of the same key is taken as it is. The key also binds a result: whoever changes
    the name, settings, seed or budget of a result by hand leaves a key that is not of its content.
    `exposed` is the digest of further files that the method is shown.
    """
    # What was added later does not change the keys of captures that have none of it.
    later = {"exposed": exposed, "free_view": free_view}
    content |= {name: digest for name, digest in later.items() if digest is not None}
    return sha256_json({**content, "recipe": RECIPE})


def key_of(results: Results, capture: CaptureResult, clip: str | None) -> str:
    """Return the key of one capture of a result, from the result's other fields.

    `clip` is the digest of the capture's free-view clip; None where it has none.
    """
    scored = {name for frame in capture.frames for name in frame.scores}
    return _key(
        method=(results.method.name, results.method.digest),
        capture=capture.digest,
        split=capture.split_digest,
        settings=dict(results.method.settings),
        seed=results.seed,
        budget=dict(results.budget),
        frames=results.frames,
        protocols=list(results.protocols.values()),
        networks=sorted({one.needs for one in METRICS if one.needs and one.name in scored}),
        exposed=capture.exposed,
        free_view=clip,
    )


# --- in another process or on another machine


def evaluate_elsewhere(
    same: tuple[Split, EvaluationSettings],
    networks: Sequence[str],
    shipped: str | None,
    key: str,
    inputs: Mapping[str, Path],
    output: Path,
    on_progress: OnProgress,
) -> None:
    """Do an evaluation in another process or on another machine; see `engine.job.Work`."""
    known = load_available() if networks else {}
    missing = [name for name in networks if name not in known]
    if missing:
        raise HwpError(
            f"what LPIPS or FLIP needs ({', '.join(missing)}) is not on this machine",
            remedy="Put them on every node, or on none.",
        )
    for path in same[1].confinement.exposed:
        if not path.exists():
            raise HwpError(
                "is not on this machine",
                where=path,
                field="--expose",
                remedy="Put what --expose and settings name at the same place on every node.",
            )
    manifest = read_manifest(inputs["method"] if shipped is None else PACKAGES / shipped)
    evaluation = CaptureEvaluation(
        manifest,
        open_capture(inputs["capture"]),
        *same,
        networks={name: known[name] for name in networks},
        method_files=manifest.contents,
    )
    if evaluation.key != key:
        raise HwpError(
            "method, capture or protocols are different on this machine",
            where=evaluation.capture.info.id,
            remedy="Install the same version everywhere, and change nothing while jobs run.",
        )
    evaluate_capture(evaluation, output, on_progress)
