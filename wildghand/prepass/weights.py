"""Weights of single pixels before any fit: does the pixel look like this hand in this light?"""

from __future__ import annotations

import cv2
import numpy as np

# Edge of the window over which residuals are shared out, px.
_WINDOW = 5
# What is left of a pixel's weight where the mask sees no hand.
_UNMASKED = 0.3


def pixel_weights(
    residual: np.ndarray,
    pixels: np.ndarray,
    mask: np.ndarray,
    normal: float,
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
        normal: median residual of the clean frames.
        residual_scale: residual, in medians, at which the weight is halved.

    Returns:
        (H, W) uint8, 255 = full weight; 255 also outside the silhouette, where there is nothing
        to judge by.
    """
    planes = np.zeros((mask.size, 2), dtype=np.float32)
    planes[pixels, 0] = residual
    planes[pixels, 1] = 1.0
    around = cv2.blur(planes.reshape(*mask.shape, 2), (_WINDOW, _WINDOW)).reshape(-1, 2)[pixels]
    shared = 0.5 * residual + 0.5 * around[:, 0] / np.maximum(around[:, 1], 1e-6)
    fit = 1.0 / (1.0 + (shared / max(residual_scale * normal, 1e-6)) ** 4)
    seen = mask.reshape(-1)[pixels] / 255.0
    weights = np.full(mask.size, 255, dtype=np.uint8)
    weights[pixels] = np.round(255.0 * fit * (_UNMASKED + (1.0 - _UNMASKED) * seen))
    return weights.reshape(mask.shape)
