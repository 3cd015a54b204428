"""Wooden building blocks with a letter on every side."""

from __future__ import annotations

import numpy as np

from hwp_bench.sim.objects.paint import albedo, canvas, ink
from hwp_bench.sim.objects.shapes import box
from hwp_bench.sim.surface import Material, Surface

_COLORS = ((0.85, 0.16, 0.14), (0.12, 0.38, 0.80), (0.95, 0.75, 0.10), (0.15, 0.58, 0.26))
_SIZES = ((0.045, 0.045, 0.045), (0.085, 0.042, 0.042), (0.05, 0.05, 0.05), (0.06, 0.04, 0.04))
_TEXTURE = 128


def build(name: str, variant: int) -> Surface:
    """Build a block; the variant chooses colour, size and letter."""
    import cv2

    color = _COLORS[variant % len(_COLORS)]
    image = canvas(_TEXTURE, _TEXTURE, color)
    cv2.rectangle(image, (14, 14), (_TEXTURE - 15, _TEXTURE - 15), ink((0.87, 0.72, 0.52)), -1)
    letter = "ABCDEFGH"[variant % 8]
    cv2.putText(image, letter, (34, 96), cv2.FONT_HERSHEY_DUPLEX, 3.0, ink(color), 12, cv2.LINE_AA)
    ticks = np.linspace(0.0, 1.0, _TEXTURE)
    grain = 1.0 + 0.05 * np.sin(60.0 * ticks + 3.0 * np.sin(5.0 * ticks))
    reflectance = np.clip(albedo(image) * grain[:, None, None], 0.0, 1.0).astype(np.float32)
    material = Material(albedo=reflectance, gloss=0.45)
    return box(_SIZES[variant % len(_SIZES)], material)
