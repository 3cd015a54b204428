"""Objects that hands hold: a wooden block, a felt-tip pen, a phone."""

from __future__ import annotations

import numpy as np

from hwp_bench.base.colors import srgb_to_linear
from hwp_bench.sim.geometry.noise import generator
from hwp_bench.sim.geometry.surface import Material, Surface, join, plain, transformed
from hwp_bench.sim.props.shapes import albedo, box, canvas, ink, turned

_BLOCK_COLORS = ((0.85, 0.16, 0.14), (0.12, 0.38, 0.80), (0.95, 0.75, 0.10), (0.15, 0.58, 0.26))
_BLOCK_SIZES = (
    (0.045, 0.045, 0.045),
    (0.085, 0.042, 0.042),
    (0.05, 0.05, 0.05),
    (0.06, 0.04, 0.04),
)
_BLOCK_PX = 128
_BARRELS = ((0.08, 0.14, 0.55), (0.75, 0.08, 0.10), (0.05, 0.05, 0.06))
_PHONE_SIZE = (0.07, 0.145, 0.008)


def build(name: str, variant: int) -> Surface:
    """Build a `block`, a `pen` or a `phone`."""
    return {"block": _block, "pen": _pen, "phone": _phone}[name](variant)


def _block(variant: int) -> Surface:
    """Build a block; the variant chooses colour, size and letter."""
    import cv2

    color = _BLOCK_COLORS[variant % len(_BLOCK_COLORS)]
    image = canvas(_BLOCK_PX, _BLOCK_PX, color)
    cv2.rectangle(image, (14, 14), (_BLOCK_PX - 15, _BLOCK_PX - 15), ink((0.87, 0.72, 0.52)), -1)
    letter = "ABCDEFGH"[variant % 8]
    cv2.putText(image, letter, (34, 96), cv2.FONT_HERSHEY_DUPLEX, 3.0, ink(color), 12, cv2.LINE_AA)
    ticks = np.linspace(0.0, 1.0, _BLOCK_PX)
    grain = 1.0 + 0.05 * np.sin(60.0 * ticks + 3.0 * np.sin(5.0 * ticks))
    reflectance = np.clip(albedo(image) * grain[:, None, None], 0.0, 1.0).astype(np.float32)
    material = Material(albedo=reflectance, gloss=0.45)
    return box(_BLOCK_SIZES[variant % len(_BLOCK_SIZES)], material)


def _pen(variant: int) -> Surface:
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


def _phone(variant: int) -> Surface:
    """Build a phone, screen to +z, its top at +y; the variant scrolls the page."""
    body = box(_PHONE_SIZE, plain((0.03, 0.03, 0.035), gloss=0.3))
    screen = Material(
        albedo=srgb_to_linear(_page(variant)).astype(np.float32), gloss=0.12, glow=0.6
    )
    move = np.eye(4)
    move[2, 3] = _PHONE_SIZE[2] / 2
    glass = transformed(box((0.065, 0.136, 0.0004), screen), move)
    lens = plain((0.01, 0.01, 0.015), gloss=0.08)
    move = np.eye(4)
    move[:3, 3] = [0.018, 0.05, -_PHONE_SIZE[2] / 2]
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
