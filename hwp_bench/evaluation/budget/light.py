"""Corrections of light: a gain of linear light, constant, by the normal, or smooth in the image."""

from __future__ import annotations

import cv2
import numpy as np

from hwp_bench.base.colors import harmonics, linear_to_srgb, srgb_to_linear
from hwp_bench.evaluation.budget.least_squares import least_error, least_squares
from hwp_bench.evaluation.budget.pair import Pair

# Largest logarithm of a gain: a factor of 20.
_LARGEST = 3.0
# Cells along each edge of the finest gain.
_CELLS = 12
# Derivative of sRGB is taken at this light and above; it grows without bound towards black.
_DARK = 2e-3


def gain(pair: Pair) -> np.ndarray:
    """One gain of each channel: exposure and white balance. Returns the image (H, W, 3)."""
    return _relit(pair, np.ones((*pair.region.shape, 1)))


def light(pair: Pair) -> np.ndarray:
    """A gain that is a function of the normal, with harmonics up to degree 2: another light."""
    return _relit(pair, harmonics(pair.normals))


def gain_map(pair: Pair) -> np.ndarray:
    """A gain on a grid of 12 x 12 over the hand's box: all that is smooth in the image."""
    rows, columns = np.nonzero(pair.region)
    top, left = rows.min(), columns.min()
    height, width = rows.max() - top + 1, columns.max() - left + 1
    identity = np.eye(_CELLS**2).reshape(-1, _CELLS, _CELLS).transpose(1, 2, 0)
    basis = np.zeros((*pair.region.shape, _CELLS**2))
    # OpenCV resamples a few channels at a time only.
    for start in range(0, _CELLS**2, 4):
        basis[top : top + height, left : left + width, start : start + 4] = cv2.resize(
            np.ascontiguousarray(identity[..., start : start + 4]), (int(width), int(height))
        ).reshape(height, width, -1)
    return _relit(pair, basis)


def _relit(pair: Pair, basis: np.ndarray) -> np.ndarray:
    """The prediction with its light multiplied by exp(basis @ c), c for each channel.

    Args:
        pair: the frame.
        basis: (H, W, K).
    """
    inner = basis[pair.region]
    light_of = srgb_to_linear(pair.prediction)
    result = pair.prediction.copy()
    for channel in range(3):
        dark, truth = light_of[..., channel][pair.region], pair.target[..., channel][pair.region]

        def lit(logs: np.ndarray, dark: np.ndarray = dark) -> np.ndarray:
            return dark * np.exp(np.clip(inner @ logs, -_LARGEST, _LARGEST))

        def error(logs: np.ndarray, truth: np.ndarray = truth) -> float:
            return float(((linear_to_srgb(lit(logs)) - truth) ** 2).sum())

        def step(logs: np.ndarray, truth: np.ndarray = truth) -> np.ndarray:
            now = lit(logs)
            way = least_squares((_slope(now) * now)[:, None] * inner, truth - linear_to_srgb(now))
            # sRGB is far from linear in the logarithm: no pixel goes further than e at a time.
            return way / max(float(np.abs(inner @ way).max()), 1.0)

        best = least_error(error, step, np.zeros(basis.shape[-1]))
        factor = np.exp(np.clip(basis @ best, -_LARGEST, _LARGEST))
        result[..., channel] = linear_to_srgb(light_of[..., channel] * factor)
    return result


def _slope(light: np.ndarray) -> np.ndarray:
    """Derivative of sRGB by linear light; 0 where the image is saturated."""
    curved = 1.055 / 2.4 * np.maximum(light, _DARK) ** (1.0 / 2.4 - 1.0)
    return np.where(light >= 1.0, 0.0, curved)
