"""Weights of single pixels before any fit: does the pixel look like this hand in this light?"""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np

# Edge of the window over which residuals are shared out, px.
_WINDOW = 5
# Least residual of clean frames, log: about what a sensor's noise leaves.
_LEAST_LEVEL = 0.03
# What is left of a pixel's weight where the mask sees no hand.
_UNMASKED = 0.3


def normal_residuals(
    residuals: Sequence[np.ndarray],
    cells: Sequence[np.ndarray],
    trusts: Sequence[float],
    cell_count: int,
    level: float,
    prior: float,
) -> np.ndarray:
    """What residual each cell of the surface has in clean frames.

    Nails, creases and places in shadow fit worse than the rest in every frame; that says nothing
    against them. Residuals are clipped at five times the level, so that one frame with an
    object does not make a place look unruly.

    Args:
        residuals: for each frame (P,) residuals.
        cells: for each frame (P,) cells.
        trusts: for each frame how much it counts, in [0, 1].
        cell_count: number of cells.
        level: median residual of the clean frames.
        prior: pixels that the level is worth.

    Returns:
        (C,) float32, at least the level, positive.
    """
    level = max(level, _LEAST_LEVEL)
    sums, mass = np.zeros(cell_count), np.zeros(cell_count)
    for residual, cell, trust in zip(residuals, cells, trusts, strict=True):
        clipped = np.minimum(residual, 5.0 * level)
        sums += trust * np.bincount(cell, clipped, minlength=cell_count)
        mass += trust * np.bincount(cell, minlength=cell_count)
    return np.maximum((sums + prior * level) / (mass + prior), level).astype(np.float32)


def pixel_weights(
    residual: np.ndarray,
    pixels: np.ndarray,
    mask: np.ndarray,
    normal: np.ndarray,
    residual_scale: float,
) -> np.ndarray:
    """Turn the residuals of the silhouette's pixels into weights.

    Half a pixel's own residual and half the mean of its surroundings go into
    1 / (1 + (r / (residual_scale * normal))^4). Outside the mask the weight is lowered, not
    zero: masks miss parts.

    Args:
        residual: (P,) not negative.
        pixels: (P,) row-major numbers of the pixels in the silhouette.
        mask: (H, W) uint8, 255 = visible hand.
        normal: (P,) positive, what the residual of the place is in clean frames.
        residual_scale: residual, in those, at which the weight is halved.

    Returns:
        (H, W) uint8, 255 = full weight; 255 also outside the silhouette, where there is nothing
        to judge by.
    """
    planes = np.zeros((mask.size, 2), dtype=np.float32)
    planes[pixels, 0] = residual
    planes[pixels, 1] = 1.0
    around = cv2.blur(planes.reshape(*mask.shape, 2), (_WINDOW, _WINDOW)).reshape(-1, 2)[pixels]
    shared = 0.5 * residual + 0.5 * around[:, 0] / np.maximum(around[:, 1], 1e-6)
    fit = 1.0 / (1.0 + (shared / (residual_scale * normal)) ** 4)
    seen = mask.reshape(-1)[pixels] / 255.0
    weights = np.full(mask.size, 255, dtype=np.uint8)
    weights[pixels] = np.round(255.0 * fit * (_UNMASKED + (1.0 - _UNMASKED) * seen))
    return weights.reshape(mask.shape)
