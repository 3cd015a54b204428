"""Recompute the digests and scores of a result from its stored predictions.

PSNR and SSIM of some frames are computed a second time, by scikit-image. Labels, keys, stored
copies and tables, on which no pixel depends, are compared with their digests.
"""

from __future__ import annotations

import contextlib
import json
import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import product, zip_longest
from pathlib import Path
from typing import Any

import numpy as np

from hwp_bench.base.arrays import evenly
from hwp_bench.base.errors import BadSplit, HwpError
from hwp_bench.base.files import inside, read_json, sha256_json
from hwp_bench.base.images import as_float
from hwp_bench.base.packages import __version__
from hwp_bench.base.tables import FORMATS, format_table
from hwp_bench.capture import Capture, open_capture
from hwp_bench.capture.check import check_capture
from hwp_bench.capture.splits import Split, split_for
from hwp_bench.evaluation.artifacts import FREE_PREDICTIONS
from hwp_bench.evaluation.capture_evaluation import RESULT, key_of
from hwp_bench.evaluation.scoring import Target, read_targets, score_frames_of
from hwp_bench.metrics import METRICS, PROTOCOLS, metric_names
from hwp_bench.metrics.lpips import load_available
from hwp_bench.metrics.protocol import HWP_V1
from hwp_bench.metrics.score import Network
from hwp_bench.report.tables import all_tables, free_view_tables
from hwp_bench.results import (
    CaptureResult,
    FrameResult,
    FreeViewResult,
    Results,
    read_results,
)
from hwp_bench.results.schema import MAX_BYTES, code_digest, environment
from hwp_bench.results.store import content_digest
from hwp_bench.suites.suite import find_missing, find_other_captures, is_of_suite
from hwp_bench.taxonomy import SUITES

#: Largest difference of a score that rounding on another processor may make.
TOLERANCE = 1e-6
#: Largest difference between a score and scikit-image's: dB of PSNR, or units of SSIM. Both are
#: computed in float64, where the sums differ only in their order.
CROSS_TOLERANCE = 1e-6
#: Most frames of a capture that are cross-checked.
CROSS_SAMPLE = 4
# Longest value of a field that a difference repeats.
_SHOWN = 100
# What is found where no predictions are kept.
_NONE = "no predictions"


@dataclass(frozen=True)
class Discrepancy:
    """One part of a result that differs from what was recomputed."""

    #: Id of the capture; empty for the whole result.
    capture: str
    #: The part that was verified: `capture`, `split`, `frames`, `predictions`, `protocols`, a label
    #: (`hands`, `perturbations`, `exact_masks`, `made_by`, `origin`), `key`, `suite`, `digest`, a
    #: stored copy or table, or a frame and metric.
    what: str
    #: Its value in the result.
    recorded: str
    #: Its value as it was found.
    found: str

    @property
    def not_here(self) -> bool:
        """Whether it shows only that a capture, a clip or the predictions are others or absent."""
        return self.what == "capture" or (self.what, self.found) == ("predictions", _NONE)


@dataclass(frozen=True)
class Verification:
    """The outcome of the verification of one result."""

    file: str
    #: Captures and frames whose scores were recomputed.
    captures: int
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
    the whole with the key and the digest that it states. The predictions lie in
    `captures/ID/predictions` next to the result file.
    """
    file = file / "results.json" if file.is_dir() else file
    results = read_results(file)
    stored = read_json(file, max_bytes=MAX_BYTES)
    found: list[Discrepancy] = []
    ours = json.loads(json.dumps({protocol.name: protocol.as_dict() for protocol in PROTOCOLS}))
    if results.protocols != ours:
        found.append(Discrepancy("", "protocols", _digests(results.protocols), _digests(ours)))
    known = _by_id(captures)
    scorer = _Scorer(load_available())
    scored, fitting = 0, []
    for record in results.captures:
        of_id = known.get(record.id, [])
        capture = next((one for one in of_id if one.digest == record.digest), None)
        before = scorer.frames
        if capture is None:
            seen = ", ".join(one.digest for one in of_id) or "no capture of this id"
            found.append(Discrepancy(record.id, "capture", record.digest, seen))
        else:
            fitting.append(capture)
            found += _capture_differences(file.parent, record, capture, splits, scorer)
        scored += scorer.frames > before
        drawn = sum(frame.failure is None for frame in record.frames)
        if record.failure is not None and drawn:
            text = f"{drawn} frames have predictions"
            found.append(Discrepancy(record.id, "failure", "every frame", text))
        clip = None if capture is None or capture.free_view is None else capture.free_view.digest
        # The key binds method, settings, seed, budget and protocols. A clip that was made after
        # the evaluation is in no key of it.
        clips = {None, clip} if record.free_view is None else {record.free_view.digest}
        if record.key not in {key_of(results, record, digest) for digest in clips}:
            text = (
                "another: method, settings, seed, budget, frames, protocols or metrics were changed"
            )
            found.append(Discrepancy(record.id, "key", record.key, text))
    if results.suite in SUITES:
        problems = find_missing(results) if splits is None else find_other_captures(results)
        foreign = [one.info.id for one in fitting if not is_of_suite(one.info, results.suite)]
        problems += [f"is of other scenes or sizes: {', '.join(foreign)}"] if foreign else []
        found += [Discrepancy("", "suite", results.suite, problem) for problem in problems]
    found += copy_differences(file.parent, stored, RESULT)
    notes = _notes(results, scorer.networks)
    own = results.environment.get("code") == code_digest()
    found += digest_differences(stored)
    if own:
        found += _table_differences(file.parent, results)
    elif (file.parent / "tables").is_dir():
        notes.append("The tables next to it were not compared: other code made them.")
    return Verification(
        str(file), scored, scorer.frames, tuple(found), tuple(notes), scorer.cross_checked
    )


def _by_id(folders: Sequence[Path]) -> dict[str, list[Capture]]:
    known: dict[str, list[Capture]] = {}
    for folder in folders:
        with contextlib.suppress(HwpError):
            capture = open_capture(folder)
            known.setdefault(capture.info.id, []).append(capture)
    return known


# --- scores


def _capture_differences(
    root: Path,
    record: CaptureResult,
    capture: Capture,
    splits: Mapping[str, Split] | None,
    scorer: _Scorer,
) -> Iterator[Discrepancy]:
    """Compare one capture of a result, and the free-view clip in it, with what is stored of it."""
    name = record.id
    damage = [item for item in check_capture(capture.root).findings if item.level == "error"]
    if damage:
        problem = f"{damage[0].where}: {damage[0].problem}"
        yield Discrepancy(name, "capture", "an intact capture", problem)
        return
    try:
        split = split_for(name, len(capture), splits)
    except BadSplit as error:
        yield Discrepancy(name, "split", record.split_digest, error.problem)
        return
    numbers = [frame.frame for frame in record.frames]
    if split.digest != record.split_digest:
        yield Discrepancy(name, "split", record.split_digest, split.digest)
    elif split.test.tolist() != numbers:
        yield Discrepancy(name, "frames", str(numbers), str(split.test.tolist()))
    if any(not 0 <= number < len(capture) for number in numbers):
        return
    targets = read_targets(capture, numbers)
    labels = {
        "hands": capture.info.hands,
        "perturbations": list(capture.info.perturbations),
        "exact_masks": all(target.exact for target in targets),
        "made_by": capture.info.made_by,
        "origin": capture.info.origin,
    }
    for label, value in labels.items():
        if getattr(record, label) != value:
            yield Discrepancy(name, label, _brief(getattr(record, label)), _brief(value))
    folder = inside(root, f"captures/{name}/predictions")
    yield from scorer.compare(name, record, targets, folder, capture.size)
    yield from _free_view_differences(root, record, capture, scorer)


def _free_view_differences(
    root: Path, record: CaptureResult, capture: Capture, scorer: _Scorer
) -> Iterator[Discrepancy]:
    """The same of the free-view clip; nothing where the result has no scores of it."""
    stored, clip, name = record.free_view, capture.free_view, f"{record.id}, free view"
    folder = inside(root, f"captures/{record.id}/{FREE_PREDICTIONS}")
    if stored is None:
        if clip is not None and folder.is_dir():
            yield Discrepancy(name, "scores", "none", "predictions")
        return
    numbers = [frame.frame for frame in stored.frames]
    if clip is None or clip.digest != stored.digest:
        yield Discrepancy(name, "capture", stored.digest, clip.digest if clip else "no clip")
    elif numbers != list(range(len(clip))):
        yield Discrepancy(name, "frames", str(numbers), f"0 to {len(clip) - 1}")
    else:
        yield from scorer.compare(name, stored, read_targets(clip, numbers), folder, clip.size)


class _Scorer:
    """Scores stored predictions again, with networks by backbone, and counts the frames."""

    def __init__(self, networks: Mapping[str, Network]) -> None:
        self.networks = networks
        self.frames = self.cross_checked = 0

    def compare(
        self,
        name: str,
        record: CaptureResult | FreeViewResult,
        targets: Sequence[Target],
        folder: Path,
        size: tuple[int, int],
    ) -> Iterator[Discrepancy]:
        """Compare recorded scores with those of the predictions in a folder."""
        scored = score_frames_of(targets, folder, size, self.networks)
        self.frames += len(targets)
        if scored.digest != record.predictions_digest:
            seen = scored.digest if folder.is_dir() else _NONE
            yield Discrepancy(name, "predictions", record.predictions_digest, seen)
        for old, new in zip(record.frames, scored.scores, strict=True):
            yield from _frame_differences(name, old, new)
        # Some scores are compared with scikit-image's too.
        rows = zip(targets, scored.predictions, record.frames, strict=True)
        valid = [(target, one.pixels, old) for target, one, old in rows if one.pixels is not None]
        for place in sample_frames(len(valid)) if valid else []:
            target, pixels, old = valid[place]
            scores = reference_scores(pixels, target.pixels, target.mask, coverage=target.exact)
            for metric, value in scores.items():
                recorded = old.scores.get(metric)
                if recorded is None or abs(recorded - value) > CROSS_TOLERANCE:
                    what = f"frame {old.frame}, {metric} by scikit-image"
                    yield Discrepancy(name, what, repr(recorded), repr(value))
            self.cross_checked += 1


def _frame_differences(name: str, old: FrameResult, new: FrameResult) -> Iterator[Discrepancy]:
    place = f"frame {old.frame}"
    if (old.failure is None) != (new.failure is None):
        yield Discrepancy(name, f"{place}, failure", old.failure or "none", new.failure or "none")
    for metric in [*(name for name in new.scores if name not in old.scores), *old.scores]:
        before, again = old.scores.get(metric), new.scores.get(metric)
        if before is None or again is None:
            differs = metric not in _with_weights()
        else:
            differs = abs(again - before) > TOLERANCE
        if differs:
            recorded = "not there" if before is None else repr(before)
            now = "no such metric" if again is None else repr(again)
            yield Discrepancy(name, f"{place}, {metric}", recorded, now)


def _with_weights() -> set[str]:
    """Names of the metrics that need weights or a package which may not be here."""
    return {facts.name for facts in METRICS if facts.needs is not None}


# --- a second opinion: nothing of `hwp_bench.metrics` is used but the protocol's settings, so that
# a fault of the toolkit's formulas cannot hide in both numbers


def sample_frames(count: int) -> list[int]:
    """Return the positions of at most `CROSS_SAMPLE` frames, evenly spread."""
    return evenly(count, CROSS_SAMPLE).tolist()


def reference_scores(
    prediction: np.ndarray,
    target: np.ndarray,
    mask: np.ndarray,
    *,
    coverage: bool,
) -> dict[str, float]:
    """Compute PSNR (dB, at most the cap) and SSIM of the scored pixels by scikit-image.

    Everything off them is black in both images, (H, W, 3) uint8 sRGB; `mask` is (H, W) uint8, the
    data set's own visible-hand mask, which may be exact coverage. The settings are those of Wang
    et al. (2004), with a Gaussian window (docs/protocol.md).
    """
    from skimage.metrics import structural_similarity

    region = _scored_region(mask, HWP_V1.mask_erosion, coverage)
    # Black beyond the frame, where scikit-image would mirror the image; only the part of the frame
    # that the windows of scored pixels reach.
    settings = HWP_V1.ssim
    border = 2 * settings.radius
    part = tuple(
        slice(int(places[0]), int(places[-1]) + 2 * border + 1)
        for places in (np.flatnonzero(region.any(axis=axis)) for axis in (1, 0))
    )
    inside = np.pad(region, border)[part]
    around = ((border, border), (border, border), (0, 0))
    x, y = (
        np.pad(np.where(region[..., None], as_float(image), 0.0), around)[part]
        for image in (prediction, target)
    )
    _, similarity = structural_similarity(
        x,
        y,
        full=True,
        channel_axis=2,
        gaussian_weights=True,
        sigma=settings.sigma,
        use_sample_covariance=settings.sample_covariance,
        data_range=settings.data_range,
        K1=settings.k1,
        K2=settings.k2,
    )
    return {
        "psnr": _psnr(x[inside], y[inside], HWP_V1.psnr_cap),
        "ssim": float(similarity.mean(axis=2)[inside].mean()),
    }


def _scored_region(mask: np.ndarray, erosion: int, coverage: bool) -> np.ndarray:
    """(H, W) bool: the pixels that the hand covers fully."""
    from skimage.morphology import dilation

    if coverage:
        return np.asarray(mask == 255)
    # The hand's border is where the background reaches; the frame's border takes nothing away.
    square = np.ones((2 * erosion + 1,) * 2, np.uint8)
    return np.asarray(dilation((mask <= 127).astype(np.uint8), square) == 0)


def _psnr(x: np.ndarray, y: np.ndarray, cap: float) -> float:
    from skimage.metrics import peak_signal_noise_ratio

    # scikit-image divides by zero where the images are equal.
    if np.array_equal(x, y):
        return cap
    value = float(peak_signal_noise_ratio(y, x, data_range=1.0))
    return cap if math.isnan(value) else min(cap, value)


# --- what no pixel decides


def digest_differences(value: Mapping[str, Any]) -> list[Discrepancy]:
    """Compare a result file with the digest that it states of its own content."""
    stated, found = content_digest(value)
    return [] if stated == found else [Discrepancy("", "digest", _brief(stated), found)]


def copy_differences(root: Path, value: Mapping[str, Any], name: str) -> list[Discrepancy]:
    """Compare each capture of a result file with the copy of it next to its predictions."""
    found = []
    for record in value["captures"]:
        place = f"captures/{record['id']}/{name}"
        try:
            path = inside(root, place)
            if not path.is_file():
                continue
            copy = read_json(path, max_bytes=MAX_BYTES)
        except HwpError as error:
            found.append(Discrepancy(record["id"], name, "a copy of this capture", error.problem))
            continue
        copy = copy if isinstance(copy, dict) else {}
        for key in sorted({*record, *copy}):
            ours, theirs = record.get(key), copy.get(key)
            if ours != theirs:
                what = f"{name}, {key}"
                found.append(Discrepancy(record["id"], what, _brief(ours), _brief(theirs)))
    return found


def _table_differences(root: Path, results: Results) -> Iterator[Discrepancy]:
    """Make the tables that an evaluation wrote next to its result again, and compare them."""
    try:
        tables = {**all_tables([results]), **free_view_tables([results])}
    except HwpError as error:
        yield Discrepancy("", "tables", "tables of the result", error.problem)
        return
    for (name, table), ending in product(tables.items(), FORMATS):
        what, made = f"tables/{name}.{ending}", format_table(table, ending)
        try:
            path = inside(root, what)
            text = path.read_text("utf-8") if path.is_file() else made
        except (HwpError, OSError, UnicodeDecodeError):
            text = ""
        if text != made:
            lines = zip_longest(text.splitlines(), made.splitlines(), fillvalue="")
            first = ((a[:_SHOWN], b[:_SHOWN]) for a, b in lines if a != b)
            yield Discrepancy("", what, *next(first, ("", "other line ends")))


def _brief(value: Any) -> str:
    text = value if isinstance(value, str) else json.dumps(value)
    return text if len(text) <= _SHOWN else f"{text[:_SHOWN]}..."


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
    recorded, ours = results.environment.get("packages"), mine["packages"]
    theirs = recorded if isinstance(recorded, dict) else {}
    other = [
        f"{package} {theirs.get(package, 'absent')} (here {ours.get(package, 'absent')})"
        for package in sorted(theirs.keys() | ours.keys())
        if theirs.get(package) != ours.get(package)
    ]
    if other:
        notes.append(f"Made with other packages: {', '.join(other)}.")
    return notes


def _digests(protocols: Mapping[str, Any]) -> str:
    digests = [f"{name} {sha256_json(value)[:12]}" for name, value in sorted(protocols.items())]
    return ", ".join(digests) or "none"
