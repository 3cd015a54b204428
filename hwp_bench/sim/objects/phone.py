"""A phone that shows a page of pictures and text."""

from __future__ import annotations

import numpy as np

from hwp_bench.base.colors import srgb_to_linear
from hwp_bench.sim.objects.shapes import box
from hwp_bench.sim.seeds import generator
from hwp_bench.sim.surface import Material, Surface, join, plain, transformed

_SIZE = (0.07, 0.145, 0.008)


def build(name: str, variant: int) -> Surface:
    """Build a phone, screen to +z, its top at +y; the variant scrolls the page."""
    body = box(_SIZE, plain((0.03, 0.03, 0.035), gloss=0.3))
    screen = Material(
        albedo=srgb_to_linear(_page(variant)).astype(np.float32), gloss=0.12, glow=0.6
    )
    move = np.eye(4)
    move[2, 3] = _SIZE[2] / 2
    glass = transformed(box((0.065, 0.136, 0.0004), screen), move)
    lens = plain((0.01, 0.01, 0.015), gloss=0.08)
    move = np.eye(4)
    move[:3, 3] = [0.018, 0.05, -_SIZE[2] / 2]
    return join([body, glass, transformed(box((0.024, 0.03, 0.002), lens), move)])


def _page(variant: int) -> np.ndarray:
    """(256, 128, 3) sRGB: a feed, scrolled by a fifth of the screen for each variant."""
    height, width = 256, 128
    rng = generator(7, "feed")
    page = np.full((height * 3, width, 3), 0.97)
    top = 8
    while top < len(page) - 90:
        color = rng.uniform(0.2, 0.9, 3)
        shade = np.linspace(1.0, 0.6, 50)[:, None, None]
        page[top : top + 50, 8:-8] = color * shade
        for line in range(3):
            end = 120 - int(rng.uniform(0, 50))
            page[top + 58 + 8 * line : top + 61 + 8 * line, 10:end] = 0.45
        top += 88
    start = int(variant * height / 5) % (height * 2)
    screen = page[start : start + height].copy()
    screen[:18] = (0.16, 0.32, 0.62)
    return screen
