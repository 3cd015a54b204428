"""The table of scores by novelty: what a method draws where training frames showed little."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from hwp_bench.analysis.novelty import Novelty, measure_novelty
from hwp_bench.base.console import track
from hwp_bench.base.errors import UsageError
from hwp_bench.base.images import read_rgb
from hwp_bench.base.tables import Cell, Column, Table
from hwp_bench.capture import Capture
from hwp_bench.capture.splits import Split, split_for
from hwp_bench.metrics.pixels import decibels, scored_pixels, squared_error
from hwp_bench.metrics.protocol import HWP_V1
from hwp_bench.report.evaluation_tables import labels
from hwp_bench.report.sources import ResultsSource, stored_predictions
from hwp_bench.results import CaptureResult

#: Upper ends of the classes of angles, degrees; the last class was never seen.
ANGLES = (5.0, 10.0, 20.0, 40.0, 180.0)
#: Upper ends of the classes of how often a place was seen, shares of the training frames.
SHARES = (0.05, 0.2, 0.5, 1.0)
_ANGLE_NAMES = ("below 5°", "5° to 10°", "10° to 20°", "20° to 40°", "above 40°", "never seen")
_SHARE_NAMES = ("never", "in 5 % or less", "in 5 to 20 %", "in 20 to 50 %", "in more than 50 %")
_OFF = "off the posed hand"
#: Rows of the table: what is new, and how much.
CLASSES = (
    *(("Angle to the nearest training normal", name) for name in (*_ANGLE_NAMES, _OFF)),
    *(("Place seen in training frames", name) for name in (*_SHARE_NAMES, _OFF)),
)


def novelty_table(sources: Sequence[ResultsSource], captures: Mapping[str, Capture]) -> Table:
    """Return one row a class of novelty and method: share of the pixels and of the error, PSNR.

    Errors are pooled over the scored pixels of all frames of all captures. Frames without a
    sound prediction are left out.

    Args:
        sources: evaluations with their predictions.
        captures: by digest.

    Raises:
        UsageError: no capture or no prediction is at hand, or a split is not the usual one.
    """
    totals = _pooled(sources, captures)
    if not any(pixels.any() for pixels, _ in totals):
        raise UsageError(
            "none of these captures, or none of the predictions, is at hand",
            field="--captures",
            remedy="Name the capture folders, and results folders that hold predictions.",
        )
    columns = (
        Column("What is new"),
        Column("Class"),
        Column("Method"),
        Column("Pixels [%]", 1),
        Column("Of the error [%]", 1),
        Column("PSNR [dB]", 2, True),
    )
    half = len(_ANGLE_NAMES) + 1
    rows: list[tuple[Cell, ...]] = []
    breaks = []
    titles = labels([source.results for source in sources])
    for index, (what, name) in enumerate(CLASSES):
        block = slice(0, half) if index < half else slice(half, None)
        breaks.append(len(rows))
        for title, (pixels, errors) in zip(titles, totals, strict=True):
            if not pixels[index]:
                continue
            rows.append(
                (
                    what,
                    name,
                    title,
                    float(100.0 * pixels[index] / pixels[block].sum()),
                    float(100.0 * errors[index] / max(errors[block].sum(), 1e-12)),
                    decibels(errors[index] / pixels[index]),
                )
            )
    notes = (
        "Classes of the scored pixels of all test frames; the squared error is pooled in each.",
        "Angle: between a pixel's normal and the nearest normal of the same 4 mm place in a "
        "training frame. Seen: share of the training frames whose mask shows the place.",
    )
    inner = tuple(place for place in dict.fromkeys(breaks) if 0 < place < len(rows))
    return Table("By novelty", columns, tuple(rows), notes, breaks=inner)


def _pooled(
    sources: Sequence[ResultsSource], captures: Mapping[str, Capture]
) -> list[tuple[np.ndarray, np.ndarray]]:
    """Scored pixels, and their squared error, of each of `CLASSES`, for each evaluation.

    Novelty is the captures' own, so that each of them is measured once for all methods.
    """
    totals = [(np.zeros(len(CLASSES)), np.zeros(len(CLASSES))) for _ in sources]
    for digest, capture in track(captures.items(), "Novelty", len(captures)):
        split = split_for(capture.info.id, len(capture))
        runs = []
        for source, total in zip(sources, totals, strict=True):
            for item in source.on(digest):
                _check_split(item, split)
                runs.append((stored_predictions(source, item), total))
        frames = sorted({frame for files, _ in runs for frame in files})
        if not frames:
            continue
        for novelty in measure_novelty(capture, split, frames):
            mask, exact = capture.scoring_mask(novelty.frame)
            region = scored_pixels(mask, erosion=HWP_V1.mask_erosion, coverage=exact)
            target = capture.frame(novelty.frame) / 255.0
            classes = classes_of(novelty, region)
            for files, (pixels, errors) in runs:
                if novelty.frame not in files:
                    continue
                prediction = read_rgb(files[novelty.frame], capture.size) / 255.0
                error = squared_error(prediction, target)[region]
                for index in classes:
                    np.add.at(pixels, index, 1.0)
                    np.add.at(errors, index, error)
    return totals


def _check_split(item: CaptureResult, split: Split) -> None:
    """Refuse a split whose training frames are not known here."""
    if split.digest != item.split_digest:
        raise UsageError(
            "was not split by the 80/10/10 rule; novelty needs its training frames",
            where=item.id,
            field="RESULTS",
        )


def classes_of(novelty: Novelty, region: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Positions in `CLASSES` of the pixels of a region, (P,) by angle and (P,) by share.

    Args:
        novelty: of the frame.
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
