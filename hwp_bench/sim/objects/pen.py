"""A felt-tip pen: barrel, clip, grip and tip."""

from __future__ import annotations

import numpy as np

from hwp_bench.base.colors import srgb_to_linear
from hwp_bench.sim.objects.shapes import box, turned
from hwp_bench.sim.surface import Surface, join, plain, transformed

_BARRELS = ((0.08, 0.14, 0.55), (0.75, 0.08, 0.10), (0.05, 0.05, 0.06))


def build(name: str, variant: int) -> Surface:
    """Build a pen of 15 cm along z and 17 mm across, its tip at -z."""
    barrel = plain(srgb_to_linear(np.array(_BARRELS[variant % len(_BARRELS)])), gloss=0.25)
    rubber = plain((0.02, 0.02, 0.02), gloss=0.8)
    metal = plain((0.55, 0.55, 0.57), gloss=0.2, specular=0.6)
    shaft = np.array([[0.0, 0.076], [0.007, 0.076], [0.0082, 0.072], [0.0084, -0.03]])
    grip = np.array([[0.0084, -0.03], [0.009, -0.035], [0.0086, -0.052], [0.0072, -0.06]])
    tip = np.array([[0.0072, -0.06], [0.0032, -0.07], [0.002, -0.076], [0.0, -0.0765]])
    move = np.eye(4)
    move[:3, 3] = [0.0, 0.0096, 0.05]
    return join(
        [
            turned(shaft, barrel),
            turned(grip, rubber),
            turned(tip, metal),
            transformed(box((0.004, 0.0022, 0.045), metal), move),
        ]
    )
