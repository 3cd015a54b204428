"""Backdrops close behind the hands, in colours of skin: wood, cardboard, sand, a beige wall."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from types import MappingProxyType

import numpy as np

from hwp_bench.base.colors import srgb_to_linear
from hwp_bench.sim.geometry.noise import fractal_noise, generator

#: Edge of a texture in texels, over slopes -1 to 1.
PLANE_TEXTURE = 1024
# Width of the soft focus, texels.
_BLUR = 1.3


def plane_names() -> tuple[str, ...]:
    """Names of these backdrops."""
    return tuple(_PAINTERS)


def plane_texture(name: str, seed: int) -> np.ndarray:
    """Paint a backdrop: (PLANE_TEXTURE, PLANE_TEXTURE, 3) float32 linear.

    Args:
        name: one of `plane_names`.
        seed: of the scene.
    """
    import cv2

    ticks = np.linspace(-1.0, 1.0, PLANE_TEXTURE)
    x, y = np.meshgrid(ticks, ticks)
    image = _PAINTERS[name](x, y, generator(seed, "plane", name))
    linear = srgb_to_linear(np.clip(image, 0.02, 1.0)).astype(np.float32)
    return cv2.GaussianBlur(linear, (0, 0), _BLUR)


def _noise(x: np.ndarray, y: np.ndarray, scale: float, rng: np.random.Generator) -> np.ndarray:
    points = np.stack([x.ravel(), y.ravel(), np.zeros(x.size)], axis=1)
    return fractal_noise(points, scale, rng).reshape(x.shape)


def _wood(x: np.ndarray, y: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Boards that run from left to right, with grain and gaps."""
    board = 0.17
    row = np.floor(y / board + 50.0).astype(int)
    tint = rng.normal(0.0, 0.05, 200)[row % 200]
    shift = rng.uniform(0.0, 4.0, 200)[row % 200]
    bend = _noise(0.35 * x + shift, 2.0 * y, 0.4, rng)
    grain = np.cos(2.0 * np.pi * (y / 0.016 + 1.5 * bend)) * (0.5 + 0.3 * bend)
    fine = _noise(0.08 * x + shift, y, 0.006, rng)
    gap = np.exp(-(((y / board + 50.0) % 1.0 / 0.022) ** 2))
    shade = 1.0 + tint + 0.045 * grain + 0.035 * fine
    color = np.array([0.76, 0.57, 0.42])
    return color * shade[..., None] ** np.array([1.0, 1.25, 1.5]) * (1.0 - 0.45 * gap)[..., None]


def _cardboard(x: np.ndarray, y: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Flutes that show through, fibres, and a fold."""
    flutes = np.cos(2.0 * np.pi * x / 0.02)
    fibres = _noise(x, 0.3 * y, 0.008, rng)
    stain = _noise(x, y, 0.35, rng)
    place = rng.uniform(-0.12, 0.12)
    fold = (y - place - 0.03 * x) / 0.006
    crease = -0.12 * np.exp(-(fold**2)) + 0.06 * np.exp(-((fold - 2.0) ** 2))
    shade = 1.0 + 0.02 * flutes + 0.03 * fibres + 0.035 * stain + crease
    return np.array([0.74, 0.59, 0.46]) * shade[..., None]


def _sand(x: np.ndarray, y: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Ripples and grains."""
    bend = _noise(x, y, 0.3, rng)
    ripples = np.sin(2.0 * np.pi * (y / 0.11 + 0.5 * bend))
    grains = rng.normal(0.0, 1.0, x.shape)
    lumps = _noise(x, y, 0.02, rng)
    shade = 1.0 + 0.07 * ripples + 0.13 * grains + 0.03 * lumps
    return np.array([0.83, 0.70, 0.57]) * shade[..., None]


def _beige_wall(x: np.ndarray, y: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Rough plaster, brighter on one side."""
    rough = _noise(x, y, 0.012, rng)
    stain = _noise(x, y, 0.6, rng)
    shade = 0.97 + 0.018 * rough + 0.025 * stain + 0.10 * x
    return np.array([0.86, 0.73, 0.64]) * shade[..., None]


_PAINTERS: Mapping[str, Callable[[np.ndarray, np.ndarray, np.random.Generator], np.ndarray]] = (
    MappingProxyType(
        {"wood": _wood, "cardboard": _cardboard, "sand": _sand, "beige_wall": _beige_wall}
    )
)
