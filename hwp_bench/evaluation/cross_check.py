"""PSNR and SSIM of a frame by scikit-image: a second opinion on the toolkit's own formulas.

Nothing of `hwp_bench.metrics` is used but the protocol's settings, so that a fault of the toolkit's
code cannot hide in both numbers.
"""

from __future__ import annotations

import math

import numpy as np

from hwp_bench.base.arrays import evenly
from hwp_bench.base.images import as_float
from hwp_bench.metrics.protocol import HWP_V1, Protocol

#: Largest difference between a score and scikit-image's: dB of PSNR, or units of SSIM. Both are
#: computed in float64, where the sums differ only in their order.
TOLERANCE = 1e-6
#: Most frames of a capture that are cross-checked.
SAMPLE = 4


def sample_frames(count: int) -> list[int]:
    """Return the positions of at most `SAMPLE` frames, evenly spaced from the first to the last."""
    return evenly(count, SAMPLE).tolist()


def reference_scores(
    prediction: np.ndarray,
    target: np.ndarray,
    mask: np.ndarray,
    *,
    coverage: bool,
    protocol: Protocol = HWP_V1,
) -> dict[str, float]:
    """Compute PSNR and SSIM of the scored pixels with scikit-image.

    Args:
        prediction: (H, W, 3) uint8 sRGB.
        target: (H, W, 3) uint8 sRGB.
        mask: (H, W) uint8, the data set's own visible-hand mask.
        coverage: whether the mask is exact coverage.
        protocol: settings; its SSIM must have the Gaussian window.

    Returns:
        `psnr` in dB, at most `protocol.psnr_cap`, and `ssim`, as `docs/protocol.md` defines them:
        the mean over the scored pixels, where everything off them is black in both images.

    Source: `skimage.metrics`, with the settings of Wang et al. (2004).
    """
    from skimage.metrics import structural_similarity

    region = _scored_region(mask, protocol.mask_erosion, coverage)
    # Black beyond the frame, where scikit-image would mirror the image; only the part of the frame
    # that the windows of scored pixels reach.
    settings = protocol.ssim
    border = 2 * settings.radius
    rows, columns = (np.flatnonzero(region.any(axis=axis)) for axis in (1, 0))
    part = (
        slice(int(rows[0]), int(rows[-1]) + 2 * border + 1),
        slice(int(columns[0]), int(columns[-1]) + 2 * border + 1),
    )
    inside = np.pad(region, border)[part]
    x, y = (
        np.pad(np.where(region[..., None], as_float(image), 0.0), ((border,) * 2,) * 2 + ((0, 0),))[
            part
        ]
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
        "psnr": _psnr(x[inside], y[inside], protocol.psnr_cap),
        "ssim": float(similarity.mean(axis=2)[inside].mean()),
    }


def _scored_region(mask: np.ndarray, erosion: int, coverage: bool) -> np.ndarray:
    """(H, W) bool: the pixels that the hand covers fully."""
    from skimage.morphology import dilation

    if coverage:
        return np.asarray(mask == 255)
    # The hand's border is where the background reaches; the frame's border takes nothing away.
    background = (mask <= 127).astype(np.uint8)
    side = 2 * erosion + 1
    return np.asarray(dilation(background, np.ones((side, side), np.uint8)) == 0)


def _psnr(x: np.ndarray, y: np.ndarray, cap: float) -> float:
    from skimage.metrics import peak_signal_noise_ratio

    # scikit-image divides by zero where the images are equal.
    if np.array_equal(x, y):
        return cap
    value = float(peak_signal_noise_ratio(y, x, data_range=1.0))
    return cap if math.isnan(value) else min(cap, value)
