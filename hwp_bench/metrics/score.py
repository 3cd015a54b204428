"""Scores: one frame in one pass, many frames on several threads, means over captures."""

from __future__ import annotations

import math
import os
from collections import deque
from collections.abc import Callable, Hashable, Iterable, Iterator, Mapping, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass

import numpy as np

from hwp_bench.base.errors import (
    BadImage,
    BadInput,
    BadPrediction,
    BadResult,
    EmptyMask,
    HwpError,
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
from hwp_bench.metrics.protocol import HWP_V1, PAPER_WILDGHAND, PROTOCOLS, Protocol, penalty

#: A distance of two (H, W, 3) float images in [0, 1]; `hwp_bench.metrics.lpips.Lpips` is one.
Network = Callable[[np.ndarray, np.ndarray], float]
#: Largest value of a float image: renderings overshoot 1, and one in 0 to 255 is a mistake.
FLOAT_LIMIT = 2.0


@dataclass(frozen=True, eq=False)
class _Pair:
    """Shared by the protocols: a checked pair of images and the error between them."""

    #: (H, W, 3) uint8.
    prediction: np.ndarray
    #: (H, W, 3) uint8.
    target: np.ndarray
    #: (H, W) bool, the hand with its mixed border pixels.
    hand: np.ndarray
    #: (H, W) bool, the pixels that the hand covers fully.
    covered: np.ndarray
    #: (H, W) float64, squared error in units of 1, mean over channels; 0 outside `hand`.
    error: np.ndarray


def score_frame(
    prediction: np.ndarray,
    target: np.ndarray,
    mask: np.ndarray,
    protocols: Iterable[Protocol] = PROTOCOLS,
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
        protocols: which protocols to score in.
        coverage: True where `mask` holds the share of each pixel that the hand covers
            (255 = all); see `region.scored_pixels`.
        networks: LPIPS by backbone name ("alex", "vgg"); metrics of an absent one are absent.

    Returns:
        metric name -> score, the names of `table.metric_names(protocols, networks)`.

    Raises:
        BadImage: target or mask have the wrong type, or the target has values that an image
            cannot have.
        BadPrediction: the same of the prediction.
        ShapeMismatch: the three do not describe the same image, or it is smaller than the
            window of SSIM.
        EmptyMask: no pixel to score; this depends on mask and protocol only, never on the
            prediction, so it is the same for every method.
    """
    target = _eight_bits(target, "target", BadImage)
    check_truth(target, mask)
    chosen = tuple(protocols)
    hand = hand_pixels(mask)
    covered = scored_pixels(mask, erosion=HWP_V1.mask_erosion, coverage=coverage)
    bounding_box(covered if HWP_V1 in chosen else hand)
    prediction = _eight_bits(prediction, "prediction", BadPrediction)
    check_prediction(prediction, target)

    unit = 1.0 / 255.0**2
    error = squared_error(composite(prediction, hand), composite(target, hand)) * unit
    pair = _Pair(prediction, target, hand, covered, error)
    scores: dict[str, float] = {}
    for protocol in chosen:
        scores |= _SCORERS[protocol.name](pair, protocol, networks or {})
    return scores


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


def _score_hwp_v1(
    pair: _Pair, protocol: Protocol, networks: Mapping[str, Network]
) -> dict[str, float]:
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
    for name, network in networks.items():
        scores[f"lpips_{name}"] = _lpips(pair, region, box, protocol, network)
    return scores


def _score_paper_wildghand(
    pair: _Pair, protocol: Protocol, networks: Mapping[str, Network]
) -> dict[str, float]:
    """The released evaluator's settings, on the data set's mask."""
    box = bounding_box(pair.hand).grown(protocol.box_padding).at_least(protocol.smallest_box)
    region = crop(pair.hand, box)
    x, y = (_on_black(image, box, region) for image in (pair.prediction, pair.target))
    scores = {
        "paper_psnr": decibels(float(pair.error.sum()) / pair.error.size, protocol.psnr_cap),
        "paper_ssim": ssim_box(x, y, region, protocol.ssim),
    }
    if "alex" in networks:
        scores["paper_lpips"] = _lpips(pair, pair.hand, box, protocol, networks["alex"])
    return scores


_SCORERS = {
    HWP_V1.name: _score_hwp_v1,
    PAPER_WILDGHAND.name: _score_paper_wildghand,
}


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


def _lpips(
    pair: _Pair, region: np.ndarray, box: Box, protocol: Protocol, network: Network
) -> float:
    """LPIPS of the box, grown to what the network's strides need."""
    box = box.at_least(protocol.smallest_lpips_box)
    inside = crop(region, box)
    return network(_on_black(pair.prediction, box, inside), _on_black(pair.target, box, inside))


#: Frames per worker that are read ahead; bounds the memory of a long list of frames.
READ_AHEAD = 4


@dataclass(frozen=True, eq=False)
class Frame:
    """One frame to score."""

    #: (H, W, 3) uint8, or the error that says why it is missing.
    prediction: np.ndarray | HwpError
    #: (H, W, 3) uint8.
    target: np.ndarray
    #: (H, W) uint8 or bool, the data set's own visible-hand mask.
    mask: np.ndarray
    #: True where the mask holds the hand's share of each pixel.
    coverage: bool = False


@dataclass(frozen=True)
class FrameScore:
    """The scores of one frame."""

    #: Metric name -> score; the declared penalties where the prediction failed; empty where
    #: the data set shows no hand to score.
    values: dict[str, float]
    #: Why the prediction failed; None where it did not.
    failure: str | None = None

    @property
    def empty(self) -> bool:
        """True where the mask leaves no pixel to score; this does not depend on the prediction."""
        return not self.values


def score_frames(
    frames: Iterable[Frame | Callable[[], Frame]],
    protocols: Iterable[Protocol] = PROTOCOLS,
    *,
    networks: Mapping[str, Network] | None = None,
    workers: int | None = None,
) -> Iterator[FrameScore]:
    """Score frames in parallel and yield the results in the order of the frames.

    Args:
        frames: the frames, or functions that read one each (they run on the workers, so
            reading files is parallel too).
        protocols: which protocols to score in.
        networks: LPIPS by backbone name; see `score_frame`.
        workers: number of threads; None takes one per core.

    Yields:
        one `FrameScore` per frame; the scores do not depend on `workers`.

    Raises:
        HwpError: the data set's own side of a frame is at fault (target or mask), or a reading
            function raised; a fault of the prediction is a `FrameScore.failure` instead.
    """
    chosen = tuple(protocols)
    available = dict(networks or {})

    def work(item: Frame | Callable[[], Frame]) -> FrameScore:
        return _score(item if isinstance(item, Frame) else item(), chosen, available)

    _keep_freed_memory()
    count = workers or os.cpu_count() or 1
    if count == 1:
        yield from map(work, frames)
        return
    pool = ThreadPoolExecutor(count, thread_name_prefix="score")
    pending: deque[Future[FrameScore]] = deque()
    try:
        for item in frames:
            pending.append(pool.submit(work, item))
            if len(pending) > READ_AHEAD * count:
                yield pending.popleft().result()
        while pending:
            yield pending.popleft().result()
    finally:
        pool.shutdown(wait=True, cancel_futures=True)


def _keep_freed_memory() -> None:
    """Let the C library keep freed arrays of a frame's size for the next frame.

    glibc hands blocks back to the kernel that are larger than the largest it has seen freed,
    up to 32 MiB; getting them again, page by page, takes longer than the arithmetic does, and
    threads wait for each other meanwhile. The block here is never touched, so it costs nothing.
    """
    np.empty(31 * 2**20, np.uint8)


def _score(
    frame: Frame, protocols: tuple[Protocol, ...], networks: Mapping[str, Network]
) -> FrameScore:
    check_truth(frame.target, frame.mask)
    prediction = frame.prediction
    failure: HwpError | None = None
    if isinstance(prediction, HwpError):
        # The mask is still checked first: a frame without a hand is not a failure of the method.
        failure, prediction = prediction, frame.target
    else:
        try:
            check_prediction(prediction, frame.target)
        except HwpError as error:
            failure, prediction = error, frame.target
    try:
        values = score_frame(
            prediction,
            frame.target,
            frame.mask,
            protocols,
            coverage=frame.coverage,
            networks={} if failure else networks,
        )
    except EmptyMask:
        return FrameScore({})
    if failure is not None:
        return FrameScore(penalty(protocols, networks), str(failure))
    return FrameScore(values)


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

    #: Over all captures.
    overall: Summary
    #: Over the captures of one hand; None if there are none.
    single: Summary | None = None
    #: Over the captures of two hands; None if there are none.
    interacting: Summary | None = None


def aggregate(captures: Iterable[CaptureScores]) -> Aggregate:
    """Average frame scores; nothing is dropped, and NaN and infinity are refused.

    Args:
        captures: the scored captures; each lists every frame that was scored.

    Returns:
        the summaries of all captures, of the single hands, and of the interacting hands.

    Raises:
        BadResult: no capture; a capture twice or without frames; a score that is NaN or
            infinite; frames that do not all have the same metrics.
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
    """Mean of each metric over `rows`, which all have the same metrics; {} for no rows."""
    listed = list(rows)
    if not listed:
        return {}
    return {
        name: math.fsum(row[name] for row in listed) / len(listed) for name in sorted(listed[0])
    }


def _summarize(captures: Sequence[CaptureScores]) -> Summary:
    by_id = sorted(captures, key=lambda capture: capture.id)
    means = {capture.id: mean_scores(capture.frames.values()) for capture in by_id}
    names = sorted({name for capture in by_id for name in capture.perturbations})
    perturbations = {
        name: mean_scores(means[c.id] for c in by_id if name in c.perturbations) for name in names
    }
    frames = [row for capture in by_id for row in capture.frames.values()]
    return Summary(
        captures=means,
        perturbations=perturbations,
        macro=mean_scores(perturbations.values()),
        capture_mean=mean_scores(means.values()),
        micro=mean_scores(frames),
    )


def _check(captures: Sequence[CaptureScores]) -> None:
    if not captures:
        raise BadResult("there are no captures to average", field="captures")
    seen: set[str] = set()
    metrics: frozenset[str] | None = None
    for capture in captures:
        if capture.id in seen:
            raise BadResult("is listed twice", where=capture.id, field="id")
        seen.add(capture.id)
        if not capture.frames:
            raise BadResult(
                "has no scored frame",
                where=capture.id,
                field="frames",
                remedy="Every capture of a result must have at least one frame with a hand.",
            )
        for frame, row in capture.frames.items():
            names = frozenset(row)
            metrics = names if metrics is None else metrics
            if names != metrics or not names:
                odd = ", ".join(sorted(names ^ metrics)) or "none at all"
                raise BadResult(
                    f"its metrics differ from the other frames' ({odd})",
                    where=capture.id,
                    field=f"frames[{frame}]",
                )
            for name, score in row.items():
                if not math.isfinite(score):
                    raise BadResult(
                        f"the score is {score}", where=capture.id, field=f"frames[{frame}].{name}"
                    )
