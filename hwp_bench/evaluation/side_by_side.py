"""One picture of several methods: the truth of a test frame and what each of them drew."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from hwp_bench.base.drawing import fitted, labelled, sheet
from hwp_bench.base.images import write_image
from hwp_bench.capture import Capture
from hwp_bench.evaluation.artifacts import EDGE
from hwp_bench.evaluation.scoring import read_prediction
from hwp_bench.metrics.pixels import scored_pixels
from hwp_bench.metrics.protocol import HWP_V1
from hwp_bench.report.sources import ResultsSource
from hwp_bench.results import CaptureResult


def write_side_by_side(
    path: Path, sources: Sequence[ResultsSource], captures: Sequence[Capture]
) -> Path:
    """Draw a row for each capture: its truth and every method, on the scored pixels.

    The frame is that of the median score, in the mean over the methods: nobody chooses it.

    Args:
        path: of the picture.
        sources: results of the same captures, with the folders that hold the predictions.
        captures: these captures.

    Returns:
        `path`.
    """
    tiles = []
    for capture in captures:
        found = [_result(source, capture.info.id) for source in sources]
        frame = _typical_frame(found)
        target = capture.frame(frame)
        mask, exact = capture.scoring_mask(frame)
        region = scored_pixels(mask, erosion=HWP_V1.mask_erosion, coverage=exact)
        box = square_around(region)

        def tile(
            pixels: np.ndarray | None,
            text: str,
            region: np.ndarray = region,
            box: tuple[slice, slice] = box,
        ) -> np.ndarray:
            image = np.zeros((*region.shape, 3), np.uint8) if pixels is None else pixels
            inside = np.where(region[..., None], image, 0)[box]
            return labelled(fitted(inside, EDGE), text)

        tiles.append(tile(target, f"truth: {capture.info.id}, frame {frame}"))
        for source, result in zip(sources, found, strict=True):
            folder = source.place(result.id, "predictions")
            pixels = read_prediction(folder, frame, capture.size).pixels if folder else None
            psnr = next(item.scores["psnr"] for item in result.frames if item.frame == frame)
            tiles.append(tile(pixels, f"{source.results.method.title}, {psnr:.1f} dB"))
    return write_image(path, sheet(tiles, columns=1 + len(sources)))


def _typical_frame(found: Sequence[CaptureResult]) -> int:
    """The frame of the median score, in the mean over the methods."""
    scores = np.mean([[frame.scores["psnr"] for frame in one.frames] for one in found], axis=0)
    order = np.argsort(scores, kind="stable")
    return found[0].frames[int(order[len(order) // 2])].frame


def square_around(region: np.ndarray) -> tuple[slice, slice]:
    """The smallest square window around some pixels, or as much of it as the image has."""
    rows, columns = (np.nonzero(region.any(axis=axis))[0] for axis in (1, 0))
    if not len(rows):
        return slice(None), slice(None)
    edge = max(np.ptp(rows), np.ptp(columns)) + 1
    windows = []
    for places, size in zip((rows, columns), region.shape, strict=True):
        start = max(0, min((places[0] + places[-1] + 1 - edge) // 2, size - edge))
        windows.append(slice(int(start), int(start + edge)))
    return windows[0], windows[1]


def _result(source: ResultsSource, capture: str) -> CaptureResult:
    return next(item for item in source.results.captures if item.id == capture)
