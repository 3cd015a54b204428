"""The pictures of an evaluation: truth, prediction and error of the worst, median, best frame."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from hwp_bench.base.drawing import error_map, fitted, labelled, sheet
from hwp_bench.base.images import write_image
from hwp_bench.capture import Capture
from hwp_bench.methods.predictions import Prediction
from hwp_bench.metrics.pixels import scored_pixels
from hwp_bench.metrics.protocol import HWP_V1
from hwp_bench.results import FrameResult

#: Larger side of a tile, px.
EDGE = 256


def telling_frames(frames: list[FrameResult], metric: str = "psnr") -> dict[str, int]:
    """Return the positions of the worst, median and best frame in a list of results."""
    order = np.argsort([frame.scores[metric] for frame in frames], kind="stable")
    return {
        "worst": int(order[0]),
        "median": int(order[len(order) // 2]),
        "best": int(order[-1]),
    }


def write_pictures(
    folder: Path,
    capture: Capture,
    frames: list[FrameResult],
    predictions: list[Prediction],
) -> Path:
    """Write `worst.png`, `median.png`, `best.png` and one sheet of the three.

    Args:
        folder: where to.
        capture: the capture.
        frames: the scores of the test frames.
        predictions: their predictions, in the same order.

    Returns:
        The sheet, `comparison.png`: a row a frame; truth in full, then truth, prediction and
        error on the scored pixels.
    """
    tiles = []
    for name, position in telling_frames(frames).items():
        row = _row(name, capture, frames[position], predictions[position])
        write_image(folder / f"{name}.png", sheet(row, columns=len(row)))
        tiles += row
    return write_image(folder / "comparison.png", sheet(tiles, columns=4))


def _row(
    name: str, capture: Capture, result: FrameResult, prediction: Prediction
) -> list[np.ndarray]:
    target = capture.frame(result.frame)
    mask, exact = capture.scoring_mask(result.frame)
    region = scored_pixels(mask, erosion=HWP_V1.mask_erosion, coverage=exact)
    if prediction.pixels is None:
        pixels, label = np.zeros_like(target), "no prediction"
    else:
        pixels, label = prediction.pixels, f"PSNR {result.scores['psnr']:.2f} dB"
    inside = region[:, :, None]
    return [
        labelled(fitted(target, EDGE), f"{name}: frame {result.frame}"),
        labelled(fitted(np.where(inside, target, 0), EDGE), "truth, scored pixels"),
        labelled(fitted(np.where(inside, pixels, 0), EDGE), f"prediction, {label}"),
        labelled(fitted(error_map(pixels, target, region), EDGE), "error (yellow: 64 levels)"),
    ]
