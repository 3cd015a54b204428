"""The formulas of PSNR and SSIM, with every convention stated (Wang et al., 2004)."""

from __future__ import annotations

import math

import cv2
import numpy as np

from hwp_bench.base.errors import ShapeMismatch
from hwp_bench.metrics.pixels import bounding_box, check_same_shape, composite, crop
from hwp_bench.metrics.protocol import HWP_V1, PAPER_WILDGHAND, PSNR_CAP, SsimSettings
from hwp_bench.metrics.ssim_kernel import similarity


def decibels(mse: float, cap: float = PSNR_CAP) -> float:
    """-10 log10(mse) for data range 1, at most `cap`; `cap` for mse = 0."""
    return cap if mse <= 0.0 else min(cap, -10.0 * math.log10(mse))


def squared_error(prediction: np.ndarray, target: np.ndarray) -> np.ndarray:
    """Squared difference of two (H, W, 3) float images, mean over channels: (H, W) float64."""
    difference = np.subtract(prediction, target, dtype=np.float64)
    return np.einsum("ijk,ijk->ij", difference, difference) / difference.shape[2]


def ssim_map(x: np.ndarray, y: np.ndarray, settings: SsimSettings = HWP_V1.ssim) -> np.ndarray:
    """SSIM of every window that lies inside the image.

    Variances are clamped at 0 and the covariance to what they allow, so that rounding can
    neither leave [-1, 1] nor make identical images differ from 1.

    Args:
        x: (H, W, 3) float64.
        y: (H, W, 3) float64.
        settings: window, covariance and data range.

    Returns:
        (H - 2r, W - 2r) float64 in [-1, 1], mean over channels, r = `settings.radius`; entry
        (0, 0) belongs to the window centred on pixel (r, r).

    Raises:
        ShapeMismatch: shapes differ, or the image is smaller than the window.
    """
    check_same_shape(x, y)
    if min(x.shape[:2]) < settings.size:
        raise ShapeMismatch(f"an image of {x.shape[:2]} is smaller than the window")
    means = [_window_mean(image, settings) for image in (x, y, x * x, y * y, x * y)]
    mean_x, mean_y, square_x, square_y, product = (mean.reshape(-1) for mean in means)
    pixels = settings.size**2
    correction = pixels / (pixels - 1) if settings.sample_covariance else 1.0
    c1 = (settings.k1 * settings.data_range) ** 2
    c2 = (settings.k2 * settings.data_range) ** 2
    similarity((mean_x, mean_y), (square_x, square_y), product, (c1, c2, correction))
    by_pixel = cv2.transform(means[-1], np.full((1, 3), 1.0 / 3.0))
    r = settings.radius
    return by_pixel[r : by_pixel.shape[0] - r, r : by_pixel.shape[1] - r]


def ssim_box(
    prediction: np.ndarray,
    target: np.ndarray,
    mask: np.ndarray,
    settings: SsimSettings = PAPER_WILDGHAND.ssim,
) -> float:
    """SSIM averaged over all windows inside the tight box of `mask`, black outside it.

    The released evaluator's form. A box smaller than the window is grown to its size.

    Args:
        prediction: (H, W, 3) float in [0, 1], sRGB.
        target: (H, W, 3) float in [0, 1], sRGB.
        mask: (H, W) bool, the scored pixels.
        settings: window, covariance and data range.

    Returns:
        the mean, in [-1, 1].

    Raises:
        ShapeMismatch: the three do not describe the same image.
        EmptyMask: no pixel to score.

    Source: protocol paper-wildghand; the oracle in the tests is scikit-image's
    `structural_similarity` with its defaults and a data range of 2.
    """
    check_same_shape(prediction, target, mask)
    box = bounding_box(mask).at_least(settings.size)
    x, y = (crop(composite(image, mask), box) for image in (prediction, target))
    return float(ssim_map(x, y, settings).mean())


def _window_mean(image: np.ndarray, settings: SsimSettings) -> np.ndarray:
    """Weighted mean of the window around every pixel; the border is cut off by the caller."""
    if settings.window == "gaussian":
        kernel = cv2.getGaussianKernel(settings.size, settings.sigma)
        return cv2.sepFilter2D(image, cv2.CV_64F, kernel, kernel)
    return cv2.boxFilter(image, cv2.CV_64F, (settings.size, settings.size))
