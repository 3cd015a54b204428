"""Evaluate one method on one capture, and put the result on record before anything else."""

from __future__ import annotations

import shutil
import tempfile
import time
from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path

from hwp_bench.base.errors import BadMethod, HwpError, MethodFailed
from hwp_bench.base.files import read_json, sha256_json, write_json
from hwp_bench.base.records import parse_record
from hwp_bench.capture import Capture
from hwp_bench.capture.splits import Split
from hwp_bench.evaluate.pictures import write_pictures
from hwp_bench.evaluate.scoring import (
    keep_predictions,
    mean_scores,
    predictions_digest,
    read_targets,
    score_predictions,
)
from hwp_bench.methods.contents import exposed_digest
from hwp_bench.methods.contract import RunSettings
from hwp_bench.methods.manifest import MethodManifest
from hwp_bench.methods.predictions import Prediction, read_predictions
from hwp_bench.methods.request import write_request
from hwp_bench.metrics import PROTOCOLS
from hwp_bench.metrics.score import Network
from hwp_bench.results import CaptureResult, CurvePoint
from hwp_bench.run.output import CHECKPOINTS, DIAGNOSTICS, RunFacts
from hwp_bench.run.runner import DEFAULT_TIME_LIMIT, RunRecord, run_method
from hwp_bench.run.sandbox.confinement import Confinement, hand_model_files

#: Most bytes of temporal weights and weight masks that are kept of a capture.
MAX_DIAGNOSTICS = 64 << 20

#: Version of what a stored capture result depends on besides its inputs.
RECIPE = 1


@dataclass(frozen=True)
class Job:
    """One method on one capture."""

    #: The method.
    manifest: MethodManifest
    #: The capture.
    capture: Capture
    #: Its split.
    split: Split
    #: Settings, seed, budget.
    run: RunSettings
    #: Seconds after which the method is killed.
    time_limit: float = DEFAULT_TIME_LIMIT
    #: How the method's process is kept apart; it decides no score.
    confinement: Confinement = field(default_factory=Confinement)
    #: LPIPS by backbone, where the weights are at hand.
    networks: Mapping[str, Network] = field(default_factory=dict)

    @property
    def key(self) -> str:
        """Digest (hex) of everything that decides the scores."""
        exposed = self.confinement.exposed
        return sha256_json(
            {
                "recipe": RECIPE,
                "method": [self.manifest.name, self.manifest.digest],
                "capture": self.capture.digest,
                "split": self.split.digest,
                "settings": dict(self.run.settings),
                "seed": self.run.seed,
                "budget": asdict(self.run.budget),
                "frames": self.run.frames,
                "protocols": [protocol.as_dict() for protocol in PROTOCOLS],
                "networks": sorted(self.networks),
                **({"exposed": exposed_digest(exposed)} if exposed else {}),
            }
        )


def evaluate_capture(
    job: Job, folder: Path, on_progress: Callable[[int, int], None] | None = None
) -> CaptureResult:
    """Run a method on a capture and score it; a stored result of the same job is taken as it is.

    Args:
        job: what to run.
        folder: where result, predictions, pictures and log go.
        on_progress: called with (done, total) steps of the fit.

    Returns:
        The result, which `folder/result.json` then holds. A method that fails gives a result
        with the reason and penalties, not an error.

    Raises:
        BadCapture, BadImage: the capture itself is damaged.
    """
    stored = stored_result(job, folder)
    if stored is not None:
        return stored
    began = time.perf_counter()
    targets = read_targets(job.capture, job.split.test.tolist())
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir(parents=True)
    output = folder / "run"
    record, failure = _run(job, output, on_progress)
    started = time.perf_counter()
    frames = [target.frame for target in targets]
    source = record.predictions if record else output / "none"
    predictions = read_predictions(source, frames, job.capture.size)
    scores = score_predictions(targets, predictions, job.networks)
    score_seconds = time.perf_counter() - started
    facts = record.facts if record else RunFacts()
    result = CaptureResult(
        id=job.capture.info.id,
        digest=job.capture.digest,
        hands=job.capture.info.hands,
        perturbations=list(job.capture.info.perturbations),
        split_digest=job.split.digest,
        exact_masks=all(target.exact for target in targets),
        key=job.key,
        frames=scores,
        failure=failure,
        predictions_digest=predictions_digest(predictions),
        fit_seconds=facts.fit_seconds,
        render_seconds=facts.render_seconds,
        score_seconds=score_seconds,
        wall_seconds=record.wall_seconds if record else 0.0,
        steps=facts.steps,
        peak_memory=facts.peak_memory,
        device=facts.device[:100] if facts.device else None,
        curve=_curve(job, output, facts),
        curve_seconds=facts.curve_seconds,
        isolation=record.isolation if record else None,
    )
    _keep(job, folder, output, source, predictions, result)
    result = replace(result, job_seconds=time.perf_counter() - began)
    write_json(folder / "result.json", asdict(result))
    return result


def stored_result(job: Job, folder: Path) -> CaptureResult | None:
    """Return the result of the same job that a folder holds, if the method did not fail in it."""
    # What a submission predicts may change without its method.toml, so it is always scored.
    if not (folder / "result.json").is_file() or job.manifest.kind == "predictions":
        return None
    try:
        result = read_result(folder)
    except HwpError:
        return None
    return result if result.key == job.key and result.failure is None else None


def read_result(folder: Path) -> CaptureResult:
    """Read the result that `evaluate_capture` left in a folder.

    Raises:
        BadInput, BadResult: it is missing or damaged.
    """
    path = folder / "result.json"
    return parse_record(CaptureResult, read_json(path), where=str(path))


def _run(
    job: Job, output: Path, on_progress: Callable[[int, int], None] | None
) -> tuple[RunRecord | None, str | None]:
    """Run the method on a copy of what it may see; returns the record, or why there is none."""
    with tempfile.TemporaryDirectory(prefix="hwp-request-") as temporary:
        request = Path(temporary) / "request"
        try:
            if job.manifest.kind != "predictions":
                write_request(request, job.capture, job.split, job.run)
            record = run_method(
                job.manifest,
                job.capture.info.id,
                request,
                output,
                time_limit=job.time_limit,
                confinement=_confinement(job, output),
                on_progress=on_progress,
            )
        except (MethodFailed, BadMethod) as error:
            return None, str(error)
    return record, None


def _confinement(job: Job, output: Path) -> Confinement:
    """Hide the capture, and what lies beside the run: pictures of test frames among them."""
    asked = job.confinement
    hands = hand_model_files(job.capture.info.hand_model.source)
    return replace(
        asked,
        exposed=(*asked.exposed, *hands),
        hidden=(*asked.hidden, job.capture.root, output.parent.parent),
    )


def _curve(job: Job, output: Path, facts: RunFacts) -> list[CurvePoint]:
    validation = set(job.split.validation.tolist())
    frames = [frame for frame in facts.checkpoint_frames if frame in validation]
    if not frames:
        return []
    targets = read_targets(job.capture, frames)
    curve = []
    for index, checkpoint in enumerate(facts.checkpoints):
        folder = output / CHECKPOINTS / f"{index:03d}"
        predictions = read_predictions(folder, frames, job.capture.size)
        scores = mean_scores(score_predictions(targets, predictions))
        curve.append(CurvePoint(**asdict(checkpoint), scores=scores))
    return curve


def _keep(
    job: Job,
    folder: Path,
    output: Path,
    source: Path,
    predictions: list[Prediction],
    result: CaptureResult,
) -> None:
    """Keep predictions, log and pictures; drop what can be made again."""
    keep_predictions(folder / "predictions", source, [p.frame for p in predictions])
    if (output / "log.txt").is_file():
        shutil.copyfile(output / "log.txt", folder / "log.txt")
    _keep_diagnostics(output / DIAGNOSTICS, folder / DIAGNOSTICS)
    shutil.rmtree(output, ignore_errors=True)
    if result.failed_frames < len(result.frames):
        write_pictures(folder / "pictures", job.capture, result.frames, predictions)


def _keep_diagnostics(source: Path, target: Path) -> None:
    """Copy temporal weights and weight masks, nothing else, and not without bound."""
    shutil.rmtree(target, ignore_errors=True)
    total = 0
    for path in sorted([*source.glob("*temporal.json"), *source.glob("weights/*.png")]):
        if path.is_symlink() or path.parent.is_symlink() or not path.is_file():
            continue
        total += path.stat().st_size
        if total > MAX_DIAGNOSTICS:
            break
        kept = target / path.relative_to(source)
        kept.parent.mkdir(parents=True, exist_ok=True)
        shutil.copyfile(path, kept)
