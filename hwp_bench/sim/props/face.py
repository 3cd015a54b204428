"""A head as a picture with transparency: relief lit from above, then out of focus."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from hwp_bench.base.colors import srgb_to_linear
from hwp_bench.sim.geometry.mesh import unit
from hwp_bench.sim.geometry.noise import fractal_noise, generator

#: Rows and columns of the picture.
ROWS, COLUMNS = 420, 360
#: What it covers, in halves of the head's height: left, right, top, bottom.
FRAME = (-1.3, 1.3, -1.2, 1.83)
# Width of the blur, of half the head's height.
_BLUR = 0.022
_LIGHT = unit(np.array([-0.45, -0.65, 0.62]))
_LIPS = (0.62, 0.30, 0.30)
_HAIR_COLORS = ((0.10, 0.07, 0.05), (0.26, 0.16, 0.09), (0.55, 0.42, 0.25))
# Paints a part, (ROWS, COLUMNS) 0-1, in a linear colour.
_Over = Callable[[np.ndarray, np.ndarray], None]


@dataclass(frozen=True)
class _Grid:
    """Places of the picture: u to the right and v down, in halves of the head's height."""

    u: np.ndarray
    v: np.ndarray

    def spot(self, u: float, v: float, wide: float, tall: float) -> np.ndarray:
        """A soft round spot, 1 in its middle."""
        return np.exp(-(((self.u - u) / wide) ** 2) - ((self.v - v) / tall) ** 2)

    def pair(self, u: float, v: float, wide: float, tall: float) -> np.ndarray:
        """A spot on either side of the face."""
        return self.spot(-u, v, wide, tall) + self.spot(u, v, wide, tall)

    def disc(self, u: float, v: float, wide: float, tall: float) -> np.ndarray:
        """An ellipse, 1 inside."""
        radius = np.hypot((self.u - u) / wide, (self.v - v) / tall)
        return np.clip((1.0 - radius) * min(wide, tall) / 0.014 + 0.5, 0.0, 1.0)


@lru_cache(maxsize=4)
def face_picture(skin: tuple[float, float, float], seed: int, closed: bool) -> np.ndarray:
    """Paint a face.

    Args:
        skin: sRGB of the skin.
        seed: which face.
        closed: whether the eyes are.

    Returns:
        (ROWS, COLUMNS, 4) float32: linear reflectance times opacity, and opacity.
    """
    import cv2

    rng = generator(seed, "face")
    wide, long_hair = rng.uniform(0.70, 0.80), rng.uniform() < 0.5
    u, v = np.meshgrid(
        np.linspace(FRAME[0], FRAME[1], COLUMNS), np.linspace(FRAME[2], FRAME[3], ROWS)
    )
    grid = _Grid(u, v)
    color = np.zeros((ROWS, COLUMNS, 3))
    alpha = np.zeros((ROWS, COLUMNS))

    def over(part: np.ndarray, linear: np.ndarray) -> None:
        nonlocal color, alpha
        color = color + part[..., None] * (linear - color)
        alpha = alpha + part * (1.0 - alpha)

    hair = srgb_to_linear(np.array(_HAIR_COLORS[int(rng.integers(len(_HAIR_COLORS)))]))
    strands = fractal_noise(
        np.stack([u.ravel(), 0.12 * v.ravel(), 0.0 * u.ravel()], axis=1), 0.05, rng
    ).reshape(u.shape)
    tress = hair * (1.0 + 0.25 * strands + 0.5 * grid.spot(-0.3, -0.75, 0.35, 0.25))[..., None]
    back = grid.disc(0.0, -0.12, wide + 0.14, 0.98)
    if long_hair:
        back = np.maximum(back, grid.disc(0.0, 0.25, wide + 0.16, 1.0))
    over(back, tress * 0.7)
    cloth = srgb_to_linear(rng.uniform(0.1, 0.7, 3))
    over(grid.disc(0.0, 2.15, 1.45, 0.98), cloth * (1.0 - 0.3 * np.abs(u))[..., None])
    neck = np.clip((0.33 - np.abs(u)) / 0.03 + 0.5, 0, 1) * ((v > 0.5) & (v < 1.35))
    base = srgb_to_linear(np.array(skin))
    over(neck, base * (0.5 - 0.35 * np.clip(1.1 - v, 0, 0.5) + 0.2 * (0.33 - np.abs(u)))[..., None])
    for side in (-1.0, 1.0):
        over(grid.disc(side * (wide + 0.02), 0.02, 0.09, 0.19), base * 0.55)
    # The jaw narrows towards the chin.
    jaw = wide * (1.0 - 0.24 * np.clip(v - 0.1, 0.0, 1.0) ** 1.3)
    inside = np.hypot(u / jaw, v / 0.98)
    over(np.clip((1.0 - inside) / 0.02 + 0.5, 0.0, 1.0), _skin(grid, base, inside, rng))
    _features(grid, over, base, hair, closed)
    top = -0.52 + 0.42 * (np.abs(u) / wide) ** 2.6 + 0.03 * strands
    if long_hair:
        top = np.maximum(top, np.where(np.abs(u) > wide - 0.10, 1.1, -1.0))
    fringe = np.clip((top - v) / 0.03 + 0.5, 0, 1) * grid.disc(0.0, -0.10, wide + 0.13, 0.99)
    if long_hair:
        fringe = np.maximum(fringe, np.clip((top - v) / 0.03 + 0.5, 0, 1) * back * (v > 0))
    over(fringe, tress)
    picture = np.concatenate([np.clip(color, 0.0, None), alpha[..., None]], axis=2)
    sigma = _BLUR * ROWS / (FRAME[3] - FRAME[2])
    return cv2.GaussianBlur(picture.astype(np.float32), (0, 0), sigma)


def _skin(
    grid: _Grid, base: np.ndarray, inside: np.ndarray, rng: np.random.Generator
) -> np.ndarray:
    """The lit relief of the face: (ROWS, COLUMNS, 3) linear."""
    u, v = grid.u, grid.v
    bridge = np.clip((v + 0.28) / 0.5, 0.0, 1.0) * np.clip((0.30 - v) / 0.06, 0.0, 1.0)
    relief = (
        0.75 * np.sqrt(np.clip(1.0 - inside**2, 0.0, 1.0))
        + 0.17 * np.exp(-((u / (0.06 + 0.05 * bridge)) ** 2)) * bridge
        + 0.05 * grid.pair(0.11, 0.24, 0.06, 0.06)
        - 0.09 * grid.pair(0.28, -0.10, 0.16, 0.11)
        + 0.05 * grid.pair(0.27, -0.27, 0.22, 0.07)
        + 0.06 * grid.pair(0.38, 0.20, 0.18, 0.18)
        + 0.05 * grid.spot(0.0, 0.50, 0.22, 0.07)
        - 0.05 * grid.spot(0.0, 0.64, 0.20, 0.05)
        + 0.07 * grid.spot(0.0, 0.80, 0.20, 0.12)
    )
    step = (FRAME[1] - FRAME[0]) / (COLUMNS - 1)
    down, right = np.gradient(relief, step)
    normals = unit(np.stack([-right, -down, np.ones_like(u)], axis=-1))
    light = 0.34 + 0.72 * np.clip((normals @ _LIGHT + 0.15) / 1.15, 0.0, None)
    blood = 0.6 * grid.pair(0.42, 0.22, 0.2, 0.17) + 0.7 * grid.spot(0.0, 0.22, 0.12, 0.1)
    mottle = rng.normal(0.0, 0.02, u.shape)
    flushed = np.exp(-(blood + mottle)[..., None] * np.array([-0.02, 0.32, 0.26]))
    return base * light[..., None] * flushed


def _features(grid: _Grid, over: _Over, base: np.ndarray, hair: np.ndarray, closed: bool) -> None:
    """Eyes, brows, nostrils and mouth."""
    dark = 0.18 * base
    for side in (-1.0, 1.0):
        at = side * 0.29
        arch = grid.v + 0.30 - 0.5 * (grid.u - at * 0.93) ** 2 * 3.0
        near = np.abs(grid.u - at) < 0.19
        over(np.exp(-((arch / 0.035) ** 2)) * near * 0.85, hair)
        if not closed:
            eye = grid.disc(at, -0.10, 0.135, 0.062)
            over(eye, np.array([0.72, 0.70, 0.68]))
            over(eye * grid.disc(at, -0.105, 0.066, 0.066), np.array([0.06, 0.045, 0.035]))
            over(grid.disc(at - 0.02, -0.13, 0.016, 0.016), np.array([0.8, 0.8, 0.8]))
        lid = (
            grid.v
            + (0.05 if closed else 0.165)
            - (1.6 if not closed else -1.0) * (grid.u - at) ** 2
        )
        over(np.exp(-((lid / 0.018) ** 2)) * (np.abs(grid.u - at) < 0.15) * 0.9, dark)
        over(0.75 * grid.disc(side * 0.075, 0.285, 0.038, 0.022), dark)
    lips = srgb_to_linear(np.array(_LIPS)) * 0.5 + 0.4 * base * np.array([1.0, 0.55, 0.55])
    over(0.8 * grid.disc(0.0, 0.50, 0.235, 0.075), lips)
    line = grid.v - 0.495 + 0.25 * grid.u**2
    over(np.exp(-((line / 0.014) ** 2)) * (np.abs(grid.u) < 0.235) * 0.85, dark)
