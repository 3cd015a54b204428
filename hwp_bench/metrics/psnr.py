"""Peak signal-to-noise ratio on the hand, its box, or the whole frame."""

from __future__ import annotations

import math

import numpy as np

from hwp_bench.base.errors import EmptyMask
from hwp_bench.metrics.pixels import check_same_shape
from hwp_bench.metrics.protocol import HWP_V1, PSNR_CAP
from hwp_bench.metrics.region import bounding_box


def decibels(mse: float, cap: float = PSNR_CAP) -> float:
    """-10 log10(mse) for data range 1, at most `cap`; `cap` for mse = 0."""
    return cap if mse <= 0.0 else min(cap, -10.0 * math.log10(mse))


def squared_error(prediction: np.ndarray, target: np.ndarray) -> np.ndarray:
    """Squared difference of two (H, W, 3) float images, mean over channels: (H, W) float64."""
    difference = np.subtract(prediction, target, dtype=np.float64)
    return np.einsum("ijk,ijk->ij", difference, difference) / difference.shape[2]


def psnr(prediction: np.ndarray, target: np.ndarray, mask: np.ndarray) -> float:
    """PSNR over the pixels of `mask` and nothing else.

    With the scored pixels of `hwp_bench.metrics.region` this is the protocol's `psnr`; with
    the uneroded mask it is `psnr_edge`.

    Args:
        prediction: (H, W, 3) float in [0, 1], sRGB.
        target: (H, W, 3) float in [0, 1], sRGB.
        mask: (H, W) bool.

    Returns:
        -10 log10(MSE) in dB with data range 1, at most `PSNR_CAP`.

    Raises:
        ShapeMismatch: the three do not describe the same image.
        EmptyMask: no pixel to score.

    Source: protocol hwp-v1, `docs/protocol.md`; the oracle in the tests is OpenImageIO's
    `compare().PSNR` on the masked pixels.
    """
    error, count = _masked_error(prediction, target, mask)
    return decibels(error / count)


def psnr_full(prediction: np.ndarray, target: np.ndarray, mask: np.ndarray) -> float:
    """PSNR over the whole frame after both images are put on black outside `mask`.

    It equals `psnr` minus 10 log10(share of the frame that the mask fills), so it mostly says
    how small the hand is. Arguments, range and errors are those of `psnr`.
    """
    error, _ = _masked_error(prediction, target, mask)
    return decibels(error / mask.size)


def psnr_box(
    prediction: np.ndarray,
    target: np.ndarray,
    mask: np.ndarray,
    padding: int = HWP_V1.box_padding,
) -> float:
    """PSNR over the box of `mask` grown by `padding` px, black outside mask and frame.

    Arguments, range and errors are otherwise those of `psnr`.
    """
    error, _ = _masked_error(prediction, target, mask)
    return decibels(error / bounding_box(mask).grown(padding).area)


def _masked_error(
    prediction: np.ndarray, target: np.ndarray, mask: np.ndarray
) -> tuple[float, int]:
    """Sum of the squared error over `mask`, and the number of its pixels."""
    check_same_shape(prediction, target, mask)
    count = int(np.count_nonzero(mask))
    if count == 0:
        raise EmptyMask("no pixel is left to score", field="mask")
    return float(squared_error(prediction, target)[mask].sum()), count
