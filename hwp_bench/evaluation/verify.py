"""Recompute the digests and scores of a result from its stored predictions.

PSNR and SSIM of some frames are computed a second time, by scikit-image. What no pixel decides is
bound otherwise (`hwp_bench/evaluation/bindings.py`).
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from hwp_bench.base.errors import BadSplit, HwpError
from hwp_bench.base.files import inside, read_json, sha256_json
from hwp_bench.base.packages import __version__
from hwp_bench.capture import Capture, open_capture
from hwp_bench.capture.check import check_capture
from hwp_bench.capture.splits import Split, split_for
from hwp_bench.evaluation import cross_check
from hwp_bench.evaluation.bindings import (
    Discrepancy,
    copy_differences,
    digest_differences,
    failure_differences,
    key_differences,
    label_differences,
    suite_differences,
    table_differences,
)
from hwp_bench.evaluation.capture_evaluation import RESULT
from hwp_bench.evaluation.free_view import PREDICTIONS as FREE_PREDICTIONS
from hwp_bench.evaluation.scoring import (
    Prediction,
    Target,
    predictions_digest,
    read_predictions,
    read_targets,
    score_predictions,
)
from hwp_bench.metrics import METRICS, PROTOCOLS, metric_names
from hwp_bench.metrics.lpips import load_available
from hwp_bench.metrics.score import Network
from hwp_bench.results import CaptureResult, FrameResult, Results, read_results
from hwp_bench.results.bounds import MAX_BYTES
from hwp_bench.results.environment import code_digest, environment

#: Largest difference of a score that rounding on another processor may make.
TOLERANCE = 1e-6


@dataclass(frozen=True)
class Verification:
    """The outcome of the verification of one result."""

    #: The result file.
    file: str
    #: Captures whose scores were recomputed.
    captures: int
    #: Frames whose scores were recomputed.
    frames: int
    #: The differences; empty where the result holds.
    discrepancies: tuple[Discrepancy, ...]
    #: Parts that could not be verified, or that differ without being wrong.
    notes: tuple[str, ...]
    #: Frames whose PSNR and SSIM scikit-image computed too.
    cross_checked: int = 0


def capture_folders(places: Sequence[Path]) -> list[Path]:
    """Return the capture folders among some folders and their subfolders."""
    found = []
    for place in places:
        candidates = [place, *(sorted(place.iterdir()) if place.is_dir() else [])]
        found += [folder for folder in candidates if (folder / "capture.json").is_file()]
    return found


def verify_results(
    file: Path, captures: Sequence[Path], splits: Mapping[str, Split] | None = None
) -> Verification:
    """Recompute the digests of captures, splits and predictions, scores and tables of a result.

    Labels are compared with the captures and the suite, each capture with its stored copy, and
    the whole with the key and the digest that it states.

    Args:
        file: the result file; the predictions lie in `captures/ID/predictions` next to it.
        captures: folders of the captures; further ones do no harm.
        splits: splits by capture id; None applies the 80/10/10 rule.

    Raises:
        BadInput, BadResult: the result file is missing or damaged.
    """
    file = file / "results.json" if file.is_dir() else file
    results = read_results(file)
    stored = read_json(file, max_bytes=MAX_BYTES)
    found: list[Discrepancy] = []
    ours = json.loads(json.dumps({protocol.name: protocol.as_dict() for protocol in PROTOCOLS}))
    if results.protocols != ours:
        found.append(Discrepancy("", "protocols", _brief(results.protocols), _brief(ours)))
    known = _by_id(captures)
    networks = load_available()
    frames = scored = checked = 0
    fitting = []
    for record in results.captures:
        capture = next((c for c in known.get(record.id, []) if c.digest == record.digest), None)
        fitting += [] if capture is None else [capture]
        differences, count, cross = _verify_capture(file.parent, record, known, splits, networks)
        clip = None if capture is None or capture.free_view is None else capture.free_view.digest
        found += [*differences, *failure_differences(record)]
        found += key_differences(results, record, clip)
        frames += count
        scored += count > 0
        checked += cross
    found += suite_differences(results, fitting, own_splits=splits is not None)
    found += copy_differences(file.parent, stored, RESULT)
    own = results.environment.get("code") == code_digest()
    if own:
        found += table_differences(file.parent, results)
    found += digest_differences(stored, expected=own)
    notes = _notes(results, networks)
    if not own and (file.parent / "tables").is_dir():
        notes.append("The tables next to it were not compared: other code made them.")
    if stored.get("digest") is None and not own:
        notes.append("It states no digest of its content: times and curves are as the file says.")
    return Verification(str(file), scored, frames, tuple(found), tuple(notes), checked)


def _by_id(folders: Sequence[Path]) -> dict[str, list[Capture]]:
    known: dict[str, list[Capture]] = {}
    for folder in folders:
        try:
            capture = open_capture(folder)
        except HwpError:
            continue
        known.setdefault(capture.info.id, []).append(capture)
    return known


def _verify_capture(
    root: Path,
    record: CaptureResult,
    known: Mapping[str, Sequence[Capture]],
    splits: Mapping[str, Split] | None,
    networks: Mapping[str, Network],
) -> tuple[list[Discrepancy], int, int]:
    """Return the differences, and how many frames were scored again and cross-checked."""
    name = record.id
    candidates = known.get(name, [])
    fitting = [capture for capture in candidates if capture.digest == record.digest]
    if not fitting:
        seen = ", ".join(capture.digest for capture in candidates) or "no capture of this id"
        return [Discrepancy(name, "capture", record.digest, seen)], 0, 0
    capture = fitting[0]
    damage = [item for item in check_capture(capture.root).findings if item.level == "error"]
    if damage:
        problem = f"{damage[0].where}: {damage[0].problem}"
        return [Discrepancy(name, "capture", "an intact capture", problem)], 0, 0
    found: list[Discrepancy] = []
    numbers = [frame.frame for frame in record.frames]
    try:
        split = split_for(name, len(capture), splits)
    except BadSplit as error:
        return [Discrepancy(name, "split", record.split_digest, error.problem)], 0, 0
    if split.digest != record.split_digest:
        found.append(Discrepancy(name, "split", record.split_digest, split.digest))
    elif split.test.tolist() != numbers:
        found.append(Discrepancy(name, "frames", str(numbers), str(split.test.tolist())))
    if any(not 0 <= number < len(capture) for number in numbers):
        return found, 0, 0
    targets = read_targets(capture, numbers)
    found += label_differences(record, capture, all(target.exact for target in targets))
    predictions = read_predictions(
        inside(root, f"captures/{name}/predictions"), numbers, capture.size
    )
    digest = predictions_digest(predictions)
    if digest != record.predictions_digest:
        found.append(Discrepancy(name, "predictions", record.predictions_digest, digest))
    for old, new in zip(
        record.frames, score_predictions(targets, predictions, networks), strict=True
    ):
        found += _compare_frame(name, old, new)
    differences, checked = _cross_check(name, record.frames, targets, predictions)
    free, count, more = _verify_free_view(root, record, capture, networks)
    return found + differences + free, len(numbers) + count, checked + more


def _verify_free_view(
    root: Path, record: CaptureResult, capture: Capture, networks: Mapping[str, Network]
) -> tuple[list[Discrepancy], int, int]:
    """As `_verify_capture`, of the free-view clip; nothing where the result has no scores of it."""
    stored, name = record.free_view, f"{record.id}, free view"
    if stored is None:
        drawn = inside(root, f"captures/{record.id}/{FREE_PREDICTIONS}")
        left = capture.free_view is not None and drawn.is_dir()
        return [Discrepancy(name, "scores", "none", "predictions")] if left else [], 0, 0
    clip = capture.free_view
    if clip is None or clip.digest != stored.digest:
        here = "no clip" if clip is None else clip.digest
        return [Discrepancy(name, "capture", stored.digest, here)], 0, 0
    numbers = [frame.frame for frame in stored.frames]
    if numbers != list(range(len(clip))):
        return [Discrepancy(name, "frames", str(numbers), f"0 to {len(clip) - 1}")], 0, 0
    targets = read_targets(clip, numbers)
    folder = inside(root, f"captures/{record.id}/{FREE_PREDICTIONS}")
    predictions = read_predictions(folder, numbers, clip.size)
    found, digest = [], predictions_digest(predictions)
    if digest != stored.predictions_digest:
        found.append(Discrepancy(name, "predictions", stored.predictions_digest, digest))
    for old, new in zip(
        stored.frames, score_predictions(targets, predictions, networks), strict=True
    ):
        found += _compare_frame(name, old, new)
    differences, checked = _cross_check(name, stored.frames, targets, predictions)
    return found + differences, len(numbers), checked


def _cross_check(
    name: str,
    frames: Sequence[FrameResult],
    targets: Sequence[Target],
    predictions: Sequence[Prediction],
) -> tuple[list[Discrepancy], int]:
    """Compare some recorded scores with scikit-image's; returns differences and frames."""
    found = []
    valid = [place for place, item in enumerate(predictions) if item.pixels is not None]
    sample = [valid[place] for place in cross_check.sample_frames(len(valid))] if valid else []
    for place in sample:
        target, pixels, old = targets[place], predictions[place].pixels, frames[place]
        assert pixels is not None
        scores = cross_check.reference_scores(
            pixels, target.pixels, target.mask, coverage=target.exact
        )
        for metric, value in scores.items():
            recorded = old.scores.get(metric)
            if recorded is None or abs(recorded - value) > cross_check.TOLERANCE:
                what = f"frame {old.frame}, {metric} by scikit-image"
                found.append(Discrepancy(name, what, repr(recorded), repr(value)))
    return found, len(sample)


def _compare_frame(name: str, old: FrameResult, new: FrameResult) -> list[Discrepancy]:
    place = f"frame {old.frame}"
    found = []
    if (old.failure is None) != (new.failure is None):
        found.append(
            Discrepancy(name, f"{place}, failure", old.failure or "none", new.failure or "none")
        )
    found += [
        Discrepancy(name, f"{place}, {metric}", "not there", repr(value))
        for metric, value in new.scores.items()
        if metric not in old.scores and metric not in _with_weights()
    ]
    for metric, value in old.scores.items():
        again = new.scores.get(metric)
        if again is None and metric not in _with_weights():
            found.append(Discrepancy(name, f"{place}, {metric}", repr(value), "no such metric"))
        elif again is not None and abs(again - value) > TOLERANCE:
            found.append(Discrepancy(name, f"{place}, {metric}", repr(value), repr(again)))
    return found


def _with_weights() -> set[str]:
    """Names of the metrics that need weights which may not be here."""
    return {facts.name for facts in METRICS if facts.weights is not None}


def _notes(results: Results, networks: Mapping[str, Network]) -> list[str]:
    notes = []
    here = metric_names(networks=networks)
    absent = [name for name in results.metrics if name in _with_weights() and name not in here]
    if absent:
        notes.append(f"Not recomputed, because their weights are missing: {', '.join(absent)}.")
    if results.toolkit != __version__:
        notes.append(f"Made with version {results.toolkit}; this is {__version__}.")
    mine = environment()
    if results.environment.get("code") != mine["code"]:
        notes.append("Made with other code of the toolkit than this.")
    ran = any(capture.isolation is not None for capture in results.captures)
    if ran and results.environment.get("caches") != mine["caches"]:
        notes.append(
            "It does not say that each run began with new caches: code that another method left "
            "may have run in it. Only a new run can tell."
        )
    recorded = results.environment.get("packages")
    theirs = recorded if isinstance(recorded, dict) else {}
    ours = mine["packages"]
    other = [
        f"{package} {theirs.get(package, 'absent')} (here {ours.get(package, 'absent')})"
        for package in sorted(theirs.keys() | ours.keys())
        if theirs.get(package) != ours.get(package)
    ]
    if other:
        notes.append(f"Made with other packages: {', '.join(other)}.")
    return notes


def _brief(protocols: Mapping[str, Any]) -> str:
    digests = [f"{name} {sha256_json(value)[:12]}" for name, value in sorted(protocols.items())]
    return ", ".join(digests) or "none"
