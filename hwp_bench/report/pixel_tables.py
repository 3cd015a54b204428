"""Tables that look at predictions again.

By novelty of the pixels, by what is drawn outside, and by how sharp it is.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import cv2
import numpy as np

from hwp_bench.analysis.columns import Filled, block_breaks, table_of
from hwp_bench.base.console import track
from hwp_bench.base.errors import UsageError
from hwp_bench.base.images import read_rgb
from hwp_bench.base.tables import Column, Table
from hwp_bench.capture import Capture
from hwp_bench.capture.splits import Split, split_for
from hwp_bench.hands.anchors import Footprint, HandSurfaces
from hwp_bench.metrics.pixels import (
    check_prediction,
    check_truth,
    composite,
    decibels,
    hand_pixels,
    scored_pixels,
    squared_error,
)
from hwp_bench.metrics.protocol import HWP_V1
from hwp_bench.report.sources import ResultsSource, stored_predictions
from hwp_bench.report.tables import labels

#: Edge of a cell, m.
PATCH = 0.004
# Training frames that are compared at a time.
_CHUNK = 64


@dataclass(frozen=True, eq=False)
class Novelty:
    """The novelty of one test frame, (H, W) each; NaN where the posed hand is not drawn."""

    #: Index of the frame.
    frame: int
    #: Angle between the normal and the nearest normal of the same place in a training frame,
    #: degrees; 180 where no training frame shows the place.
    angle: np.ndarray
    #: Share of the training frames that show the place, 0 to 1.
    seen: np.ndarray


def measure_novelty(capture: Capture, split: Split, frames: Sequence[int]) -> Iterator[Novelty]:
    """Compare test frames with the training frames.

    Hands are where the truth has them, or the estimates where the capture knows no truth. A
    training frame shows a place where its given mask has a pixel of it.
    """
    surfaces = HandSurfaces({side: capture.template(side) for side in capture.info.sides}, PATCH)
    hands = capture.true_hands or capture.hands
    valid = np.all([hand.valid for hand in hands.values()], axis=0)
    train = split.train[valid[split.train]]
    count = len(surfaces.cell_normals)
    normals = np.zeros((len(train), count, 3), dtype=np.float32)
    for row, footprint in enumerate(_footprints(surfaces, capture, train)):
        shown = hand_pixels(capture.mask(int(train[row]))).reshape(-1)[footprint.pixels]
        normals[row] = _mean_normals(footprint.cells[shown], footprint.normals[shown], count)
    known = (normals != 0.0).any(axis=2)
    share = known.mean(axis=0) if len(train) else np.zeros(count)
    test = np.array(frames, dtype=np.int64)
    for frame, footprint in zip(frames, _footprints(surfaces, capture, test), strict=True):
        cells = np.unique(footprint.cells)
        mine = _mean_normals(footprint.cells, footprint.normals, count)[cells]
        nearest = np.full(len(cells), -1.0)
        for start in range(0, len(train), _CHUNK):
            part = slice(start, start + _CHUNK)
            cosines = np.einsum("fck,ck->fc", normals[part][:, cells], mine)
            cosines[~known[part][:, cells]] = -1.0
            nearest = np.maximum(nearest, cosines.max(axis=0))
        place = np.searchsorted(cells, footprint.cells)
        angle, seen = (np.full(capture.size, np.nan) for _ in range(2))
        degrees = np.degrees(np.arccos(np.clip(nearest, -1.0, 1.0)))
        angle.reshape(-1)[footprint.pixels] = degrees[place]
        seen.reshape(-1)[footprint.pixels] = share[footprint.cells]
        yield Novelty(frame, angle, seen)


def _footprints(
    surfaces: HandSurfaces, capture: Capture, frames: np.ndarray
) -> Iterator[Footprint]:
    cameras = capture.cameras
    return surfaces.footprints(
        capture.true_hands or capture.hands, cameras.Ks, cameras.viewmats, frames, capture.size
    )


def _mean_normals(cells: np.ndarray, normals: np.ndarray, count: int) -> np.ndarray:
    """(C, 3) float32 unit mean normal of each cell; zeros where no pixel shows it."""
    sums = np.stack([np.bincount(cells, normals[:, k], count) for k in range(3)], axis=1)
    length = np.linalg.norm(sums, axis=1, keepdims=True)
    unit: np.ndarray = np.where(length > 1e-6, sums / np.maximum(length, 1e-6), 0.0)
    return unit.astype(np.float32)


#: A pixel of a prediction shows something if a channel is above this; methods draw over black.
LIT = 12
#: Where a mask does not know each pixel's coverage, its outline is uncertain by this much, px.
UNCERTAIN = 2
# A pixel with those around it. The outermost pixels of a drawing mix its colours with black.
_RIM = np.ones((3, 3), np.uint8)


class OutlineScores(NamedTuple):
    """One frame, by what its prediction draws outside of the hand."""

    #: PSNR of the headline protocol, dB.
    psnr: float
    #: Lit pixels that the hand does not touch, as a share of the scored pixels.
    drawn_outside: float
    #: The same error and that of all pixels that the hand does not touch, which should be black,
    #: over the number of scored pixels, dB.
    psnr_with_outside: float
    #: The headline's PSNR if every pixel outside of the drawn hand took the nearest colour of it,
    #: dB.
    psnr_spread: float


def outline_scores(
    prediction: np.ndarray, target: np.ndarray, mask: np.ndarray, *, coverage: bool = False
) -> OutlineScores | None:
    """Score a frame with and without what lies outside of the hand.

    Args:
        prediction: (H, W, 3) uint8 sRGB over black.
        target: (H, W, 3) uint8.
        mask: (H, W) uint8 or bool, the data set's own visible-hand mask.
    """
    check_truth(target, mask)
    check_prediction(prediction, target)
    region = scored_pixels(mask, erosion=HWP_V1.mask_erosion, coverage=coverage)
    count = int(np.count_nonzero(region))
    if not count:
        return None
    outside = _untouched(mask, coverage=coverage)
    lit = prediction.max(axis=2) > LIT
    black = composite(target, ~outside)
    error = squared_error(prediction, black)
    spread = squared_error(spread_outwards(prediction, lit), black)

    def score(errors: np.ndarray, pixels: np.ndarray) -> float:
        return decibels(float(errors[pixels].sum()) / (count * 255.0**2))

    return OutlineScores(
        psnr=score(error, region),
        drawn_outside=float(np.count_nonzero(lit & outside)) / count,
        psnr_with_outside=score(error, region | outside),
        psnr_spread=score(spread, region),
    )


def spread_outwards(prediction: np.ndarray, lit: np.ndarray) -> np.ndarray:
    """Give every pixel outside of a drawn hand, and its rim, the nearest colour within.

    Args:
        prediction: (H, W, 3) uint8.
        lit: (H, W) bool, where something is drawn.
    """
    from scipy.ndimage import distance_transform_edt

    within = cv2.erode(lit.astype(np.uint8), _RIM, borderValue=1) > 0
    if not within.any():
        return prediction
    rows, columns = distance_transform_edt(~within, return_distances=False, return_indices=True)
    return np.asarray(prediction[rows, columns])


def _untouched(mask: np.ndarray, *, coverage: bool) -> np.ndarray:
    """(H, W) bool: pixels that the hand does not touch."""
    if coverage and mask.dtype != np.bool_:
        return mask == 0
    near = cv2.dilate(hand_pixels(mask).astype(np.uint8), _RIM, iterations=UNCERTAIN)
    return near == 0


#: Upper ends of the classes of angles, degrees; the last class was never seen.
ANGLES = (5.0, 10.0, 20.0, 40.0, 180.0)
#: Upper ends of the classes of how often a place was seen, shares of the training frames.
SHARES = (0.05, 0.2, 0.5, 1.0)
_ANGLE_NAMES = ("below 5°", "5° to 10°", "10° to 20°", "20° to 40°", "above 40°", "never seen")
_SHARE_NAMES = ("never", "in 5 % or less", "in 5 to 20 %", "in 20 to 50 %", "in more than 50 %")
_OFF = "off the posed hand"
_COMMON = "Frames of which one method has no sound prediction are left out for all."
#: Rows of the table: what is new, and how much.
CLASSES = (
    *(("Angle to the nearest training normal", name) for name in (*_ANGLE_NAMES, _OFF)),
    *(("Place seen in training frames", name) for name in (*_SHARE_NAMES, _OFF)),
)


def novelty_table(sources: Sequence[ResultsSource], captures: Mapping[str, Capture]) -> Table:
    """Return one row per class of novelty and method: share of the pixels and of the error, PSNR.

    Errors are pooled over the scored pixels of all frames of all captures. Frames of which one
    method has no sound prediction are left out for all.
    """
    totals, used = _pooled(sources, captures)
    if not any(pixels.any() for pixels, _ in totals):
        raise UsageError(
            "none of these captures, or none of the predictions, is at hand",
            field="--capture",
            remedy="Name the capture folders, and results folders that hold predictions.",
        )
    half = len(_ANGLE_NAMES) + 1
    titles = labels([source.results for source in sources])
    shown = []
    for index, named in enumerate(CLASSES):
        block = slice(0, half) if index < half else slice(half, None)
        for title, (pixels, errors) in zip(titles, totals, strict=True):
            if pixels[index]:
                share = float(100.0 * pixels[index] / pixels[block].sum())
                part = float(100.0 * errors[index] / max(errors[block].sum(), 1e-12))
                psnr = decibels(errors[index] / pixels[index])
                shown.append((named, title, share, part, psnr))
    keys, methods, shares, parts, scores = zip(*shown, strict=True)
    columns: list[Filled] = [
        (Column("What is new"), [what for what, _ in keys]),
        (Column("Class"), [name for _, name in keys]),
        (Column("Method"), methods),
        (Column("Pixels [%]", 1), shares),
        (Column("Of the error [%]", 1), parts),
        (Column("PSNR [dB]", 2, True), scores),
    ]
    notes = (
        "Classes of the scored pixels of test frames; the squared error is pooled in each.",
        "Angle: between a pixel's normal and the nearest normal of the same 4 mm place in a "
        "training frame. Seen: share of the training frames whose mask shows the place.",
        _COMMON,
        *_left_out(sources, used),
    )
    return table_of("By novelty", columns, notes, breaks=block_breaks(keys))


def _pooled(
    sources: Sequence[ResultsSource], captures: Mapping[str, Capture]
) -> tuple[list[tuple[np.ndarray, np.ndarray]], set[str]]:
    """Scored pixels, and their squared error, of each of `CLASSES`, for each evaluation.

    Returned too are the digests of the captures that they are of. Novelty is the captures' own, so
    that each of them is measured once for all methods.
    """
    totals = [(np.zeros(len(CLASSES)), np.zeros(len(CLASSES))) for _ in sources]
    used = set()
    for digest, capture in track(captures.items(), "Novelty", len(captures)):
        split = split_for(capture.info.id, len(capture))
        runs = []
        for source, total in zip(sources, totals, strict=True):
            for item in source.on(digest):
                if split.digest != item.split_digest:
                    raise UsageError(
                        "was not split by the 80/10/10 rule; novelty needs its training frames",
                        where=item.id,
                        field="RESULTS",
                    )
                runs.append((stored_predictions(source, item), total))
        # Of frames that all have: a method must not gain by leaving out what is hard.
        frames = sorted(set.intersection(*(set(files) for files, _ in runs))) if runs else []
        if not frames:
            continue
        used.add(digest)
        for novelty in measure_novelty(capture, split, frames):
            mask, exact = capture.scoring_mask(novelty.frame)
            region = scored_pixels(mask, erosion=HWP_V1.mask_erosion, coverage=exact)
            target = capture.frame(novelty.frame) / 255.0
            classes = classes_of(novelty, region)
            for files, (pixels, errors) in runs:
                prediction = read_rgb(files[novelty.frame], capture.size) / 255.0
                error = squared_error(prediction, target)[region]
                for index in classes:
                    np.add.at(pixels, index, 1.0)
                    np.add.at(errors, index, error)
    return totals, used


def _left_out(sources: Sequence[ResultsSource], used: Collection[str]) -> list[str]:
    """Name the captures of the results that a table is not of, in a note."""
    every = {item.digest: item.id for source in sources for item in source.results.captures}
    lost = [name for digest, name in every.items() if digest not in used]
    if not lost:
        return []
    return [
        f"Of {len(every) - len(lost)} of {len(every)} captures. Not at hand with predictions of "
        f"every method, or with nothing to measure: {', '.join(lost)}."
    ]


def classes_of(novelty: Novelty, region: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Positions in `CLASSES` of the pixels of a region, (P,) by angle and (P,) by share.

    Args:
        region: (H, W) bool, P pixels.
    """
    angle, seen = novelty.angle[region], novelty.seen[region]
    off = np.isnan(angle)
    by_angle = np.searchsorted(ANGLES[:-1], np.nan_to_num(angle), side="right")
    by_angle[seen == 0.0] = len(_ANGLE_NAMES) - 1
    by_angle[off] = len(_ANGLE_NAMES)
    start = len(_ANGLE_NAMES) + 1
    by_share = 1 + np.searchsorted(SHARES, np.nan_to_num(seen), side="left")
    by_share[seen == 0.0] = 0
    by_share[off] = len(_SHARE_NAMES)
    return by_angle, start + by_share


_NOTES = (
    "Means over captures of the means over test frames. Outside are pixels that the hand does not "
    "touch; lit ones of them, as a share of the scored pixels, are drawn outside.",
    "With the outside: the error of these pixels, which should be black, is added. If spread: the "
    "headline's PSNR if the drawn hand went on outwards in its nearest colours.",
    "A hand behind a sleeve or an object counts as drawn outside, for every method alike.",
    _COMMON,
)


def outline_table(sources: Sequence[ResultsSource], captures: Mapping[str, Capture]) -> Table:
    """Return one row per method: PSNR, what is drawn outside, and PSNR with it and with more of it.

    Frames of which one method has no sound prediction are left out for all, and captures that are
    not at hand for every method.
    """
    found, used = _score_again(sources, captures, "Outlines", outline_scores)
    means = [OutlineScores(*np.mean(scores, axis=0)) for scores in found]
    columns: list[Filled] = [
        (Column("Method"), labels([source.results for source in sources])),
        (Column("PSNR [dB]", 2, True), [mean.psnr for mean in means]),
        (Column("Drawn outside [%]", 1, False), [100.0 * mean.drawn_outside for mean in means]),
        (Column("With the outside [dB]", 2, True), [mean.psnr_with_outside for mean in means]),
        (Column("If spread [dB]", 2), [mean.psnr_spread for mean in means]),
    ]
    return table_of("By outline", columns, (*_NOTES, *_left_out(sources, used)))


#: Standard deviations of the blurs whose differences are the bands, px.
BLURS = (0.0, 1.0, 2.0, 4.0)
#: The bands: what the first blur takes away, then those with the strongest wavelength, px, between
#: two neighbours (6.5 times the smaller standard deviation).
BANDS = ("finer than 5 px", "6.5 px", "13 px")
# Mean square of a band, in units of 1, below which the truth has nothing to draw: 8 bits cause it.
_NOTHING = 0.25 / 255.0**2


class BandPower(NamedTuple):
    """One frame's mean products over the scored pixels, by band."""

    #: (B,) of the prediction with itself, of the truth with itself, and of the two.
    drawn: np.ndarray
    true: np.ndarray
    both: np.ndarray


def band_power(
    prediction: np.ndarray, target: np.ndarray, mask: np.ndarray, *, coverage: bool = False
) -> BandPower | None:
    """Measure the bands of two images of a hand.

    What is outside of the scored pixels has no effect: blurs are means over those inside.

    Args:
        prediction: (H, W, 3) uint8 sRGB.
        target: (H, W, 3) uint8.
        mask: (H, W) uint8 or bool, the data set's own visible-hand mask.
    """
    check_truth(target, mask)
    check_prediction(prediction, target)
    region = scored_pixels(mask, erosion=HWP_V1.mask_erosion, coverage=coverage)
    if not region.any():
        return None
    # Both images at once, as six channels.
    drawn, true = np.split(_bands(np.dstack((prediction, target)), region), 2, axis=2)
    return BandPower(*(_products(*pair) for pair in ((drawn, drawn), (true, true), (drawn, true))))


def _bands(image: np.ndarray, region: np.ndarray) -> np.ndarray:
    """(B, P, C) float64: the bands of an image at the pixels of a region, in units of 1."""
    inside = region.astype(np.float64)
    values = composite(image, region) / 255.0
    levels = [values[region]]
    for sigma in BLURS[1:]:
        weight = cv2.GaussianBlur(inside, (0, 0), sigma, borderType=cv2.BORDER_CONSTANT)
        blurred = cv2.GaussianBlur(values, (0, 0), sigma, borderType=cv2.BORDER_CONSTANT)
        levels.append(blurred[region] / weight[region][:, None])
    return -np.diff(np.stack(levels), axis=0)


def _products(one: np.ndarray, other: np.ndarray) -> np.ndarray:
    found: np.ndarray = (one * other).mean(axis=(1, 2))
    return found


_SHARP_NOTES = (
    "Bands of the scored pixels: what a Gaussian blur of 1 px removes, and what lies between blurs "
    "of 1 and 2 and of 2 and 4 px, named by the strongest wavelength.",
    "Spectrum ratio: amplitude of the drawn band over the truth's; below 1 is too smooth, above 1 "
    "has what the truth has not. Correlation: 1 where the drawn structure is the truth's. Pooled "
    "over the frames of a capture, then means over captures.",
    "The noise of a camera counts as structure of the truth.",
    _COMMON,
)


def sharpness_table(sources: Sequence[ResultsSource], captures: Mapping[str, Capture]) -> Table:
    """Return one row per method: how much of the truth's fine structure it draws, band by band.

    Frames of which one method has no sound prediction are left out for all, and captures that are
    not at hand for every method, or whose truth has nothing in a band.
    """
    found, used = _score_again(sources, captures, "Sharpness", band_power)
    # (methods, captures, 3, B)
    power = np.array(found)
    textured = np.all(power[0, :, 1] > _NOTHING, axis=1)
    if not textured.any():
        raise UsageError("the hands of these captures have no structure", field="--capture")
    drawn, true, both = np.moveaxis(power[:, textured], 2, 0)
    ratio = np.sqrt(drawn / true).mean(axis=1)
    correlation = (both / np.sqrt(np.maximum(drawn * true, _NOTHING**2))).mean(axis=1)
    columns: list[Filled] = [(Column("Method"), labels([source.results for source in sources]))]
    for group, values, better in (
        ("Spectrum ratio", ratio, None),
        ("Correlation", correlation, True),
    ):
        for index, name in enumerate(BANDS):
            column = Column(name, 2, better, group)
            columns.append((column, [float(value) for value in values[:, index]]))
    measured = [used[place] for place in np.flatnonzero(textured)]
    return table_of("By sharpness", columns, (*_SHARP_NOTES, *_left_out(sources, measured)))


def _score_again(
    sources: Sequence[ResultsSource],
    captures: Mapping[str, Capture],
    what: str,
    score: Callable[..., Sequence[float | np.ndarray] | None],
) -> tuple[list[list[np.ndarray]], list[str]]:
    """Each method's means over the test frames of every capture that all methods have.

    Returned too are the digests of these captures.
    """
    found: list[list[np.ndarray]] = [[] for _ in sources]
    used = []
    for digest, capture in track(captures.items(), what, len(captures)):
        if means := _means(sources, digest, capture, score):
            used.append(digest)
            for scores, mean in zip(found, means, strict=True):
                scores.append(mean)
    if not found or not found[0]:
        raise UsageError(
            "none of these captures is at hand with the predictions of every method",
            field="--capture",
            remedy="Name the capture folders, and results folders that hold predictions.",
        )
    return found, used


def _means(
    sources: Sequence[ResultsSource],
    digest: str,
    capture: Capture,
    score: Callable[..., Sequence[float | np.ndarray] | None],
) -> list[np.ndarray]:
    """Each method's means over the test frames of a capture; empty where one has none to score."""
    runs = [
        {
            frame: path
            for item in source.on(digest)
            for frame, path in stored_predictions(source, item).items()
        }
        for source in sources
    ]
    if not all(runs):
        return []
    scores: list[list[np.ndarray]] = [[] for _ in sources]
    # Each frame is read once for all methods, and only where all have it: a method must not gain
    # by leaving out what is hard.
    for frame in sorted(set.intersection(*map(set, runs))):
        target, (mask, exact) = capture.frame(frame), capture.scoring_mask(frame)
        for files, mine in zip(runs, scores, strict=True):
            prediction = read_rgb(files[frame], capture.size)
            one = score(prediction, target, mask, coverage=exact)
            if one is not None:
                mine.append(np.array(one))
    return [np.mean(mine, axis=0) for mine in scores] if all(scores) else []
