"""Scores: one frame in one pass, many frames on several threads, means over captures."""

from __future__ import annotations

import math
import os
from collections.abc import Callable, Hashable, Iterable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from typing import Any

import numpy as np

from hwp_bench.base.errors import (
    BadImage,
    BadInput,
    BadPrediction,
    BadResult,
    ShapeMismatch,
)
from hwp_bench.base.images import as_uint8
from hwp_bench.metrics.pixels import (
    Box,
    bounding_box,
    check_prediction,
    check_truth,
    composite,
    crop,
    decibels,
    hand_pixels,
    oriented_distance,
    scored_pixels,
    squared_error,
    ssim_box,
    ssim_map,
)
from hwp_bench.metrics.protocol import HWP_V1, METRICS, PAPER_WILDGHAND, Protocol, penalty

#: A distance of a prediction and a target, (H, W, 3) float in [0, 1]: one number, such as
#: `hwp_bench.metrics.lpips.Lpips`, or (H, W), of which the mean over the scored pixels is taken.
Network = Callable[[np.ndarray, np.ndarray], Any]
#: Largest value of a float image: renderings overshoot 1, and one in 0 to 255 is a mistake.
FLOAT_LIMIT = 2.0


@dataclass(frozen=True, eq=False)
class _Pair:
    """Shared by the protocols: a checked pair of images and the error between them."""

    #: (H, W, 3) uint8.
    prediction: np.ndarray
    target: np.ndarray
    #: (H, W) bool, the hand with its mixed border pixels.
    hand: np.ndarray
    #: (H, W) bool, the pixels that the hand covers fully.
    covered: np.ndarray
    #: (H, W) float64, squared error in units of 1, mean over channels; 0 outside `hand`.
    error: np.ndarray
    #: LPIPS by backbone, and FLIP.
    networks: Mapping[str, Network]


def score_frame(
    prediction: np.ndarray,
    target: np.ndarray,
    mask: np.ndarray,
    *,
    coverage: bool = False,
    networks: Mapping[str, Network] | None = None,
) -> dict[str, float]:
    """Score one predicted frame.

    Pixels outside the mask never matter, in either image.

    Args:
        prediction: (H, W, 3) uint8, or float in [0, 1], sRGB. A float image is scored as the 8 bits
            that it has on disk: clipped, rounded half to even.
        target: (H, W, 3) like `prediction`.
        mask: (H, W) uint8 (above 127 is hand) or bool, the data set's own visible-hand mask.
        coverage: whether the mask holds the hand's share of each pixel.
        networks: LPIPS by backbone, and FLIP: those of `load_available`.
    """
    target = _eight_bits(target, "target", BadImage)
    check_truth(target, mask)
    hand = hand_pixels(mask)
    covered = scored_pixels(mask, erosion=HWP_V1.mask_erosion, coverage=coverage)
    bounding_box(covered)
    prediction = _eight_bits(prediction, "prediction", BadPrediction)
    check_prediction(prediction, target)

    unit = 1.0 / 255.0**2
    error = squared_error(composite(prediction, hand), composite(target, hand)) * unit
    pair = _Pair(prediction, target, hand, covered, error, networks or {})
    return {**_score_hwp_v1(pair), **_score_paper_wildghand(pair)}


def _eight_bits(image: np.ndarray, field: str, error: type[BadInput]) -> np.ndarray:
    """The image as uint8; float images are converted, and an impossible one is refused by name."""
    if not np.issubdtype(image.dtype, np.floating):
        return image
    try:
        pixels = as_uint8(image)
    except BadImage as found:
        raise error(f"the {field} cannot be scored: {found.problem}", field=field) from found
    if image.size and image.max() > FLOAT_LIMIT:
        raise error(
            f"the {field} is a float image with values up to {image.max():.4g}",
            field=field,
            remedy="A float image has values from 0 to 1; divide one of 0 to 255 by 255.",
        )
    return pixels


def _score_hwp_v1(pair: _Pair, protocol: Protocol = HWP_V1) -> dict[str, float]:
    """The headline protocol, on the pixels that the hand covers fully."""
    region, cap, radius = pair.covered, protocol.psnr_cap, protocol.ssim.radius
    box = bounding_box(region).grown(protocol.box_padding).at_least(protocol.smallest_box)
    total, count = float(pair.error[region].sum()), int(np.count_nonzero(region))

    wide = box.grown(radius)
    wide_region = crop(region, wide)
    x, y = (_on_black(image, wide, wide_region) for image in (pair.prediction, pair.target))
    similarity = ssim_map(x, y, protocol.ssim)
    scores = {
        "psnr": decibels(total / count, cap),
        "ssim": float(similarity[crop(region, box)].mean()),
        "oriented_distance": oriented_distance(x, y, wide_region, protocol.box_padding),
        "psnr_full": decibels(total / region.size, cap),
        "psnr_box": decibels(total / box.area, cap),
        "psnr_edge": decibels(float(pair.error[pair.hand].mean()), cap),
        "ssim_full": _whole_frame_mean(similarity, box, region.shape, radius),
    }
    return scores | _network_scores(pair, region, box, protocol)


def _score_paper_wildghand(pair: _Pair, protocol: Protocol = PAPER_WILDGHAND) -> dict[str, float]:
    """The released evaluator's settings, on the data set's mask."""
    box = bounding_box(pair.hand).grown(protocol.box_padding).at_least(protocol.smallest_box)
    region = crop(pair.hand, box)
    x, y = (_on_black(image, box, region) for image in (pair.prediction, pair.target))
    scores = {
        "paper_psnr": decibels(float(pair.error.sum()) / pair.error.size, protocol.psnr_cap),
        "paper_ssim": ssim_box(x, y, region, protocol.ssim),
    }
    return scores | _network_scores(pair, pair.hand, box, protocol)


def _on_black(image: np.ndarray, box: Box, region: np.ndarray) -> np.ndarray:
    """The box of an 8-bit image as float64 in [0, 1], black outside `region` (of the box)."""
    return composite(crop(image, box), region) / 255.0


def _whole_frame_mean(
    similarity: np.ndarray, box: Box, shape: tuple[int, ...], radius: int
) -> float:
    """The mean SSIM over all windows of a frame from the map of the box.

    Windows centred outside the box see black in both images and count exactly 1.
    """
    rows, columns = shape[0] - 2 * radius, shape[1] - 2 * radius
    if min(rows, columns) < 1:
        raise ShapeMismatch(f"an image of {shape[:2]} is smaller than the window of SSIM")
    top, left = max(0, radius - box.top), max(0, radius - box.left)
    inside = similarity[top : shape[0] - radius - box.top, left : shape[1] - radius - box.left]
    return float((inside.sum() + (rows * columns - inside.size)) / (rows * columns))


def _network_scores(
    pair: _Pair, region: np.ndarray, box: Box, protocol: Protocol
) -> dict[str, float]:
    """LPIPS and FLIP of the box, grown to what the networks' strides need."""
    box = box.at_least(protocol.smallest_lpips_box)
    inside = crop(region, box)
    scores = {}
    for facts in METRICS:
        if facts.protocol == protocol.name and facts.needs and facts.needs in pair.networks:
            images = (_on_black(image, box, inside) for image in (pair.prediction, pair.target))
            found = np.asarray(pair.networks[facts.needs](*images), np.float64)
            scores[facts.name] = float(found[inside].mean() if found.ndim else found)
    return scores


@dataclass(frozen=True, eq=False)
class ScoredFrame:
    """One frame to score."""

    #: (H, W, 3) uint8; None where there is no prediction that could be scored.
    prediction: np.ndarray | None
    #: (H, W, 3) uint8.
    target: np.ndarray
    #: (H, W) uint8 or bool, the data set's own visible-hand mask.
    mask: np.ndarray
    #: True where the mask holds the hand's share of each pixel.
    coverage: bool = False


def score_frames(
    frames: Iterable[ScoredFrame],
    *,
    networks: Mapping[str, Network] | None = None,
    workers: int | None = None,
) -> list[dict[str, float]]:
    """Score frames in parallel; one without a prediction has the declared penalties."""
    chosen = networks or {}

    def score(frame: ScoredFrame) -> dict[str, float]:
        if frame.prediction is None:
            return penalty(chosen)
        pair = frame.prediction, frame.target, frame.mask
        return score_frame(*pair, coverage=frame.coverage, networks=chosen)

    _keep_freed_memory()
    with ThreadPoolExecutor(workers or os.cpu_count(), thread_name_prefix="score") as pool:
        return list(pool.map(score, frames))


def _keep_freed_memory() -> None:
    """Let the C library keep freed arrays of a frame's size for the next frame.

    glibc hands blocks back to the kernel that are larger than the largest it has seen freed,
    up to 32 MiB; getting them again, page by page, takes longer than the arithmetic does, and
    threads wait for each other meanwhile. The block here is never touched, so it costs nothing.
    """
    np.empty(31 * 2**20, np.uint8)


Scores = dict[str, float]


@dataclass(frozen=True)
class CaptureScores:
    """The frame scores of one capture."""

    #: Name of the capture, unique in one aggregation.
    id: str
    #: "right", "left" or "both".
    hands: str
    #: Perturbations of the capture; may be empty.
    perturbations: tuple[str, ...]
    #: Frame -> metric -> score: every scored frame, the penalties of failed ones included.
    frames: Mapping[Hashable, Mapping[str, float]]

    @property
    def interacting(self) -> bool:
        """True where two hands are shown."""
        return self.hands == "both"


@dataclass(frozen=True)
class Summary:
    """Means over one set of captures, metric -> score each."""

    #: Mean over the frames of each capture, by capture.
    captures: dict[str, Scores]
    #: Mean over the captures with it, by perturbation.
    perturbations: dict[str, Scores]
    #: Mean over the perturbations: each perturbation counts the same. Empty where no capture
    #: has one.
    macro: Scores
    #: Mean over the captures: each capture counts the same.
    capture_mean: Scores
    #: Mean over all frames: each frame counts the same.
    micro: Scores


@dataclass(frozen=True)
class Aggregate:
    """The summaries that tables are made of."""

    overall: Summary
    #: Over the captures of one hand; None if there are none.
    single: Summary | None = None
    #: Over the captures of two hands; None if there are none.
    interacting: Summary | None = None


def aggregate(captures: Iterable[CaptureScores]) -> Aggregate:
    """Average frame scores; nothing is dropped.

    Sums are exact before they are rounded once (`math.fsum`), so the order of captures and frames
    never changes a digit.
    """
    listed = list(captures)
    _check(listed)
    single = [capture for capture in listed if not capture.interacting]
    interacting = [capture for capture in listed if capture.interacting]
    return Aggregate(
        overall=_summarize(listed),
        single=_summarize(single) if single else None,
        interacting=_summarize(interacting) if interacting else None,
    )


def mean_scores(rows: Iterable[Mapping[str, float]]) -> Scores:
    """Mean over `rows` of each metric that all of them have; {} for no rows."""
    listed = list(rows)
    if not listed:
        return {}
    names = sorted(set(listed[0]).intersection(*listed[1:]))
    return {name: math.fsum(row[name] for row in listed) / len(listed) for name in names}


def _summarize(captures: Sequence[CaptureScores]) -> Summary:
    by_id = sorted(captures, key=lambda capture: capture.id)
    means = {capture.id: mean_scores(capture.frames.values()) for capture in by_id}
    names = sorted({name for capture in by_id for name in capture.perturbations})
    perturbations = {
        name: mean_scores(means[c.id] for c in by_id if name in c.perturbations) for name in names
    }
    return Summary(
        captures=means,
        perturbations=perturbations,
        macro=mean_scores(perturbations.values()),
        capture_mean=mean_scores(means.values()),
        micro=mean_scores(row for capture in by_id for row in capture.frames.values()),
    )


def _check(captures: Sequence[CaptureScores]) -> None:
    if not captures:
        raise BadResult("there are no captures to average", field="captures")
    seen: set[str] = set()
    metrics: set[str] | None = None
    for capture in captures:
        if capture.id in seen:
            raise BadResult("is listed twice", where=capture.id, field="id")
        seen.add(capture.id)
        if not capture.frames:
            remedy = "Every capture of a result must have at least one frame with a hand."
            raise BadResult("has no scored frame", where=capture.id, field="frames", remedy=remedy)
        for frame, row in capture.frames.items():
            place = f"frames[{frame}]"
            metrics = set(row) if metrics is None else metrics
            if set(row) != metrics or not row:
                odd = ", ".join(sorted(set(row) ^ metrics)) or "none at all"
                problem = f"its metrics differ from the other frames' ({odd})"
                raise BadResult(problem, where=capture.id, field=place)
