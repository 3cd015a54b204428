"""Smoothing within a region alone."""

from __future__ import annotations

import cv2
import numpy as np


def smooth_within(values: np.ndarray, region: np.ndarray, breadth: float) -> np.ndarray:
    """Gaussian mean over the pixels of a region alone.

    Args:
        values: (H, W) or (H, W, C).
        region: (H, W) bool.
        breadth: deviation of the Gaussian, px.

    Returns:
        float32 of the values' shape, next to the region too; towards zero far from it.
    """
    inside = region.reshape(*region.shape, *(1,) * (values.ndim - 2))
    weight = cv2.GaussianBlur(region.astype(np.float32), (0, 0), breadth)
    total = cv2.GaussianBlur(np.where(inside, values, 0.0).astype(np.float32), (0, 0), breadth)
    return np.asarray(total / np.maximum(weight.reshape(inside.shape), 1e-3))
