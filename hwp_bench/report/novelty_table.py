"""The table of scores by novelty: what a method draws where training frames showed little."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence

import numpy as np

from hwp_bench.analysis.novelty import Novelty, measure_novelty
from hwp_bench.base.errors import UsageError
from hwp_bench.base.images import read_rgb
from hwp_bench.base.progress import track
from hwp_bench.base.tables import Cell, Column, Table
from hwp_bench.capture import Capture
from hwp_bench.capture.schema import frame_name
from hwp_bench.capture.splits import Split, split_for
from hwp_bench.metrics.pixels import scored_pixels
from hwp_bench.metrics.protocol import HWP_V1
from hwp_bench.metrics.psnr_ssim import decibels, squared_error
from hwp_bench.report.evaluation_tables import labels
from hwp_bench.report.sources import ResultsSource
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
    totals = [_pooled(source, captures) for source in sources]
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
    source: ResultsSource, captures: Mapping[str, Capture]
) -> tuple[np.ndarray, np.ndarray]:
    """Scored pixels, and their squared error, of each of `CLASSES`."""
    pixels, errors = np.zeros(len(CLASSES)), np.zeros(len(CLASSES))
    found = [item for item in source.results.captures if item.digest in captures]
    for item in track(found, source.results.method.title, len(found)):
        capture = captures[item.digest]
        split = split_for(item.id, len(capture))
        if split.digest != item.split_digest:
            raise UsageError(
                "was not split by the 80/10/10 rule; novelty needs its training frames",
                where=item.id,
                field="RESULTS",
            )
        for index, error in _classified(source, item, capture, split):
            np.add.at(pixels, index, 1.0)
            np.add.at(errors, index, error)
    return pixels, errors


def _classified(
    source: ResultsSource, item: CaptureResult, capture: Capture, split: Split
) -> Iterator[tuple[np.ndarray, np.ndarray]]:
    """For each predicted frame twice, by angle and by share: classes and errors of its pixels."""
    folder = source.place(item.id, "predictions")
    scored = [frame.frame for frame in item.frames if frame.failure is None]
    if folder is None or not folder.is_dir():
        return
    for novelty in measure_novelty(capture, split, scored):
        path = folder / frame_name(novelty.frame)
        if not path.is_file() or path.is_symlink():
            continue
        prediction = read_rgb(path, capture.size) / 255.0
        mask, exact = capture.scoring_mask(novelty.frame)
        region = scored_pixels(mask, erosion=HWP_V1.mask_erosion, coverage=exact)
        error = squared_error(prediction, capture.frame(novelty.frame) / 255.0)[region]
        angle, share = classes_of(novelty, region)
        yield angle, error
        yield share, error


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
