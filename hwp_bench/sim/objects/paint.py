"""Painting textures: 8-bit sRGB canvases for OpenCV's brushes, and albedo made of them."""

from __future__ import annotations

import numpy as np

from hwp_bench.base.colors import srgb_to_linear

Color = tuple[float, float, float]


def canvas(height: int, width: int, color: Color) -> np.ndarray:
    """An image of one colour: (H, W, 3) uint8."""
    image = np.empty((height, width, 3), dtype=np.uint8)
    image[:] = ink(color)
    return image


def ink(color: Color) -> tuple[int, int, int]:
    """A colour in 0-1 as OpenCV's brushes take it."""
    red, green, blue = (round(255 * channel) for channel in color)
    return red, green, blue


def albedo(image: np.ndarray) -> np.ndarray:
    """Linear reflectance of a painted (H, W, 3) uint8 image: float32."""
    return srgb_to_linear(image / 255.0).astype(np.float32)
