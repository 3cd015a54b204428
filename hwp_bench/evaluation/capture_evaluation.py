"""Evaluate one method on one capture: run it, score its predictions, store the result."""

from __future__ import annotations

import time
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field, replace
from functools import partial
from pathlib import Path

from hwp_bench.base.errors import BadMethod, HwpError, MethodFailed, bounded, one_line, shown
from hwp_bench.base.files import disc_errors, read_json, write_json
from hwp_bench.base.folders import remove_tree, scratch_folder
from hwp_bench.base.packages import PACKAGES
from hwp_bench.base.records import MAX_TEXT, parse_record
from hwp_bench.capture import Capture, open_capture
from hwp_bench.capture.check import refuse_changed
from hwp_bench.capture.schema import EXTRA, IMAGE_FOLDERS
from hwp_bench.capture.splits import Split
from hwp_bench.evaluation.artifacts import keep_artifacts
from hwp_bench.evaluation.colour_check import colour_warnings, keep_warnings
from hwp_bench.evaluation.evaluation_key import evaluation_key
from hwp_bench.evaluation.free_view import keep_free_view, read_free_targets, score_free_view
from hwp_bench.evaluation.scoring import (
    mean_scores,
    predictions_digest,
    read_prediction,
    read_predictions,
    read_targets,
    score_predictions,
)
from hwp_bench.methods.contents import (
    digest_of,
    exposed_digest,
    left_out_folders,
    method_files,
)
from hwp_bench.methods.contract import FRAME_CHOICES, RunSettings
from hwp_bench.methods.manifest import MethodManifest, read_manifest
from hwp_bench.methods.request import write_request
from hwp_bench.methods.setting_files import ships
from hwp_bench.metrics import PROTOCOLS
from hwp_bench.metrics.lpips import load_available
from hwp_bench.metrics.score import Network
from hwp_bench.results import CaptureResult, CurvePoint
from hwp_bench.results.walls import WALLED
from hwp_bench.run.engine import Folder, Job, Needs
from hwp_bench.run.engine.job import OnProgress, ignore
from hwp_bench.run.output import LOG, RunFacts, checkpoint_folder
from hwp_bench.run.runner import DEFAULT_TIME_LIMIT, RunRecord, run_method
from hwp_bench.run.sandbox.confinement import Confinement, hand_model_files

#: The result of one capture, inside its folder.
RESULT = "result.json"


@dataclass(frozen=True)
class CaptureEvaluation:
    """One method on one capture."""

    #: The method.
    manifest: MethodManifest
    #: The capture.
    capture: Capture
    #: Its split.
    split: Split
    #: Settings, seed, budget and training frames.
    run: RunSettings
    #: Seconds after which the method is killed.
    time_limit: float = DEFAULT_TIME_LIMIT
    #: How the method's process is confined; it decides no score.
    confinement: Confinement = field(default_factory=Confinement)
    #: LPIPS by backbone, where the weights are there.
    networks: Mapping[str, Network] = field(default_factory=dict)
    #: Digests of the method's files when the evaluation was planned; None takes them as they are.
    method_files: Mapping[str, str] | None = None

    @property
    def method_digest(self) -> str:
        """Digest (hex) of the method."""
        planned = self.method_files
        return self.manifest.digest if planned is None else digest_of(planned)

    @property
    def exposed(self) -> str | None:
        """Digest (hex) of the files that the method is shown next to its request, if any."""
        exposed = self.confinement.exposed
        return exposed_digest(exposed) if exposed else None

    @property
    def key(self) -> str:
        """Digest (hex) of everything that decides the scores."""
        clip = self.capture.free_view
        return evaluation_key(
            method=(self.manifest.name, self.method_digest),
            capture=self.capture.digest,
            split=self.split.digest,
            settings=self.run.settings,
            seed=self.run.seed,
            budget=asdict(self.run.budget),
            frames=self.run.frames,
            protocols=[protocol.as_dict() for protocol in PROTOCOLS],
            networks=self.networks,
            exposed=self.exposed,
            free_view=None if clip is None else clip.digest,
        )


def evaluate_capture(
    evaluation: CaptureEvaluation, folder: Path, on_progress: OnProgress = ignore
) -> CaptureResult:
    """Run a method on a capture and score it; a stored result of the same key is taken as it is.

    Args:
        evaluation: the method, the capture and the settings.
        folder: where result, predictions, images and log go.
        on_progress: called with (done, total) steps of the fit.

    Returns:
        The result, which `folder/result.json` then holds. A method that fails gives a result
        with the reason and penalties, not an error.

    Raises:
        BadCapture, BadImage: the capture itself is damaged, or was changed after it was written.
        BadMethod: files of the method changed while it ran.
        HwpError: `folder` cannot be written to.
    """
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
    targets = read_targets(evaluation.capture, evaluation.split.test.tolist())
    free_targets = read_free_targets(evaluation.capture)
    _refuse_changed(evaluation)
    remove_tree(folder)
    folder.mkdir(parents=True)
    output = folder / "run"
    record, failure = _run(evaluation, output, on_progress)
    _refuse_edited(evaluation)
    started = time.perf_counter()
    frames = [target.frame for target in targets]
    source = record.predictions if record else output / "none"
    predictions = read_predictions(source, frames, evaluation.capture.size)
    scores = score_predictions(targets, predictions, evaluation.networks)
    score_seconds = time.perf_counter() - started
    offered = record.free_view if record else output / "none"
    free = score_free_view(evaluation.capture, free_targets, offered, evaluation.networks)
    facts = record.facts if record else RunFacts()
    result = CaptureResult(
        id=evaluation.capture.info.id,
        digest=evaluation.capture.digest,
        hands=evaluation.capture.info.hands,
        perturbations=list(evaluation.capture.info.perturbations),
        split_digest=evaluation.split.digest,
        exact_masks=all(target.exact for target in targets),
        key=evaluation.key,
        frames=scores,
        failure=None if failure is None else shown(failure)[:MAX_TEXT],
        predictions_digest=predictions_digest(predictions),
        fit_seconds=facts.fit_seconds,
        render_seconds=facts.render_seconds,
        score_seconds=score_seconds,
        wall_seconds=record.wall_seconds if record else 0.0,
        steps=facts.steps,
        peak_memory=facts.peak_memory,
        device=one_line(facts.device, 100) if facts.device else None,
        curve=_curve(evaluation, output, facts),
        curve_seconds=facts.curve_seconds,
        cpu_seconds=facts.cpu_seconds,
        isolation=one_line(record.isolation) if record and record.isolation else None,
        free_view=free.result if free else None,
        made_by=evaluation.capture.info.made_by,
        exposed=evaluation.exposed,
    )
    if free is not None:
        keep_free_view(folder, free)
    keep_warnings(folder, colour_warnings(targets, predictions))
    keep_artifacts(folder, output, source, evaluation.capture, scores, predictions)
    result = replace(result, job_seconds=time.perf_counter() - began)
    write_json(folder / RESULT, asdict(result))
    return result


def _refuse_edited(evaluation: CaptureEvaluation) -> None:
    """Refuse to score a run of a method whose files are not those that it began with.

    Raises:
        BadMethod: files were changed, added or removed since the evaluation was planned.
    """
    planned = evaluation.method_files
    if planned is None:
        return
    found = method_files(evaluation.manifest.root)
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
    """Refuse a capture, or a clip in it, whose content is not that of the digests.

    Raises:
        BadCapture, BadImage: as `hwp_bench.capture.check.refuse_changed`.
    """
    clean = evaluation.run.frames != FRAME_CHOICES[0]
    for capture in (evaluation.capture, evaluation.capture.free_view):
        if capture is None:
            continue
        kinds = ["frames", "masks"]
        kinds += ["true_masks"] if capture.has_true_masks else []
        kinds += ["clean", "clean_masks"] if clean and capture.has_clean else []
        there = [kind for kind in kinds if (capture.root / IMAGE_FOLDERS[kind]).is_dir()]
        refuse_changed(capture, there)


def stored_result(evaluation: CaptureEvaluation, folder: Path) -> CaptureResult | None:
    """Return the stored result of the same key, if there is one and the method did not fail.

    Where walls are required, a result that was made without them is none.
    """
    # Submitted predictions may change without their method.toml, so they are always scored.
    if not (folder / RESULT).is_file() or evaluation.manifest.kind == "predictions":
        return None
    try:
        result = read_result(folder)
    except HwpError:
        return None
    if evaluation.confinement.mode == "required" and result.isolation != WALLED:
        return None
    return result if result.key == evaluation.key and result.failure is None else None


def read_result(folder: Path) -> CaptureResult:
    """Read the result that `evaluate_capture` left in a folder.

    Raises:
        BadInput, BadResult: it is missing or damaged.
    """
    path = folder / RESULT
    return parse_record(CaptureResult, read_json(path), where=str(path))


def _run(
    evaluation: CaptureEvaluation, output: Path, on_progress: OnProgress
) -> tuple[RunRecord | None, str | None]:
    """Run the method on a copy of what it may see; returns the record, or why it failed."""
    with scratch_folder("hwp-request-") as temporary:
        request = temporary / "request"
        try:
            if evaluation.manifest.kind != "predictions":
                write_request(request, evaluation.capture, evaluation.split, evaluation.run)
            record = run_method(
                evaluation.manifest,
                evaluation.capture.info.id,
                request,
                output,
                time_limit=evaluation.time_limit,
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


def _lacks_images(evaluation: CaptureEvaluation, record: RunRecord, output: Path) -> bool:
    """Whether an image that a run should have left is missing or damaged."""
    capture, facts = evaluation.capture, record.facts
    wanted = [(record.predictions, evaluation.split.test.tolist(), capture.size)]
    clip = capture.free_view
    if clip is not None and record.free_view is not None:
        wanted.append((record.free_view, list(range(len(clip))), clip.size))
    for index in range(len(facts.checkpoints)):
        folder = checkpoint_folder(output, index)
        wanted.append((folder, facts.checkpoint_frames, capture.size))
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


def _confinement(evaluation: CaptureEvaluation, output: Path) -> Confinement:
    """Hide what holds test frames, the capture and results next to the run, and undigested code."""
    asked = evaluation.confinement
    hands = hand_model_files(evaluation.capture.info.hand_model.source)
    root = evaluation.manifest.root.resolve()
    # What is in no digest must decide no score. Shipped methods keep their compiled modules.
    odd = [] if ships(root) else left_out_folders(root)
    return replace(
        asked,
        exposed=(*asked.exposed, *hands),
        hidden=(*asked.hidden, *odd, evaluation.capture.root, output.parent.parent),
    )


def _curve(evaluation: CaptureEvaluation, output: Path, facts: RunFacts) -> list[CurvePoint]:
    validation = set(evaluation.split.validation.tolist())
    frames = [frame for frame in dict.fromkeys(facts.checkpoint_frames) if frame in validation]
    if not frames:
        return []
    targets = read_targets(evaluation.capture, frames)
    curve = []
    for index, checkpoint in enumerate(facts.checkpoints):
        folder = checkpoint_folder(output, index)
        predictions = read_predictions(folder, frames, evaluation.capture.size)
        scores = mean_scores(score_predictions(targets, predictions))
        curve.append(CurvePoint(**asdict(checkpoint), scores=scores))
    return curve


def evaluation_job(evaluation: CaptureEvaluation, folder: Path, text: str, needs: Needs) -> Job:
    """Return an evaluation as a job of an engine.

    Args:
        evaluation: the evaluation.
        folder: where its result goes.
        text: what a person is shown.
        needs: the share of a machine that it takes.
    """
    root = evaluation.manifest.root.resolve()
    shipped = root.relative_to(PACKAGES).as_posix() if root.is_relative_to(PACKAGES) else None
    inputs = {"capture": Folder(evaluation.capture.root, (EXTRA,))}
    if shipped is None:
        inputs["method"] = Folder(root)
    return Job(
        text=text,
        here=partial(evaluate_capture, evaluation, folder),
        work=EvaluateElsewhere(
            evaluation.split,
            evaluation.run,
            evaluation.time_limit,
            evaluation.confinement,
            tuple(sorted(evaluation.networks)),
            shipped,
            evaluation.key,
        ),
        output=folder,
        finished=lambda: stored_result(evaluation, folder) is not None,
        inputs=inputs,
        needs=needs,
    )


@dataclass(frozen=True)
class EvaluateElsewhere:
    """An evaluation on its way to another process or machine, which opens method and capture."""

    #: The split of the capture.
    split: Split
    #: Settings, seed, budget and training frames.
    run: RunSettings
    #: Seconds after which the method is killed.
    time_limit: float
    #: How the method's process is confined.
    confinement: Confinement
    #: Backbones of LPIPS that are scored.
    networks: tuple[str, ...]
    #: Place of a method that ships with the toolkit; None where the method is sent.
    shipped: str | None
    #: Key of the evaluation where it was ordered; it must be the same here.
    key: str

    def __call__(self, inputs: Mapping[str, Path], output: Path, on_progress: OnProgress) -> None:
        """Evaluate; see `hwp_bench.run.engine.job.Work`.

        Raises:
            HwpError: method, capture, weights or protocols differ here.
        """
        known = load_available() if self.networks else {}
        missing = [name for name in self.networks if name not in known]
        if missing:
            raise HwpError(
                f"the weights of LPIPS ({', '.join(missing)}) are not on this machine",
                remedy="Put them on every node, or on none.",
            )
        method = inputs["method"] if self.shipped is None else PACKAGES / self.shipped
        manifest = read_manifest(method)
        evaluation = CaptureEvaluation(
            manifest,
            open_capture(inputs["capture"]),
            self.split,
            self.run,
            self.time_limit,
            self.confinement,
            {name: known[name] for name in self.networks},
            method_files(manifest.root),
        )
        if evaluation.key != self.key:
            raise HwpError(
                "method, capture or protocols are different on this machine",
                where=evaluation.capture.info.id,
                remedy="Install the same version everywhere, and change nothing while jobs run.",
            )
        evaluate_capture(evaluation, output, on_progress)
