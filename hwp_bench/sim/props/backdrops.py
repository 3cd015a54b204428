"""Backdrops behind the hands: rooms out of focus, and planes close behind in colours of skin."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import lru_cache
from types import MappingProxyType

import numpy as np

from hwp_bench.base.colors import srgb_to_linear
from hwp_bench.base.errors import BadInput
from hwp_bench.sim.geometry.noise import fractal_noise, generator

#: Edge of a texture in texels, over slopes -1 to 1.
PLANE_TEXTURE = 1024
# Width of the soft focus, texels.
_PLANE_BLUR = 1.3


def plane_names() -> tuple[str, ...]:
    """Names of these backdrops."""
    return tuple(_PAINTERS)


def plane_texture(name: str, seed: int) -> np.ndarray:
    """Paint a backdrop: (PLANE_TEXTURE, PLANE_TEXTURE, 3) float32 linear."""
    import cv2

    ticks = np.linspace(-1.0, 1.0, PLANE_TEXTURE)
    x, y = np.meshgrid(ticks, ticks)
    image = _PAINTERS[name](x, y, generator(seed, "plane", name))
    linear = srgb_to_linear(np.clip(image, 0.02, 1.0)).astype(np.float32)
    return cv2.GaussianBlur(linear, (0, 0), _PLANE_BLUR)


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


_TEXTURE = 384


@dataclass(frozen=True)
class Backdrop:
    """A wall and a table, both blurred by the distance."""

    #: sRGB of the wall.
    wall: tuple[float, float, float]
    #: sRGB of the table.
    table: tuple[float, float, float]
    #: How far below the centre of the image the table's edge is, as a slope.
    edge: float
    #: Number of things that stand around.
    clutter: int


_BACKDROPS: Mapping[str, Backdrop] = MappingProxyType(
    {
        "office": Backdrop((0.72, 0.74, 0.76), (0.55, 0.42, 0.30), 0.10, 9),
        "kitchen": Backdrop((0.84, 0.80, 0.72), (0.80, 0.79, 0.77), 0.06, 12),
        "study": Backdrop((0.42, 0.45, 0.42), (0.36, 0.24, 0.16), 0.12, 14),
        "studio": Backdrop((0.58, 0.62, 0.68), (0.64, 0.66, 0.70), 0.16, 3),
        "living": Backdrop((0.66, 0.56, 0.48), (0.48, 0.36, 0.28), 0.08, 11),
        "workshop": Backdrop((0.50, 0.50, 0.44), (0.62, 0.48, 0.32), 0.11, 16),
        "bedroom": Backdrop((0.78, 0.68, 0.70), (0.70, 0.62, 0.58), 0.13, 6),
        "garden": Backdrop((0.34, 0.46, 0.28), (0.46, 0.42, 0.32), 0.07, 18),
        "bathroom": Backdrop((0.80, 0.88, 0.90), (0.90, 0.90, 0.88), 0.09, 7),
        "garage": Backdrop((0.44, 0.42, 0.46), (0.30, 0.30, 0.32), 0.12, 15),
        "cafe": Backdrop((0.52, 0.34, 0.26), (0.26, 0.16, 0.11), 0.08, 13),
        "corridor": Backdrop((0.70, 0.72, 0.66), (0.50, 0.46, 0.42), 0.14, 4),
        "classroom": Backdrop((0.82, 0.82, 0.70), (0.66, 0.54, 0.36), 0.10, 10),
        "library": Backdrop((0.46, 0.36, 0.28), (0.40, 0.28, 0.18), 0.09, 18),
    }
)


def backdrop_names() -> tuple[str, ...]:
    """Names of the backdrops that a scene can name."""
    return (*_BACKDROPS, *plane_names())


def check_backdrop(name: str, where: str) -> None:
    """Refuse an unknown backdrop."""
    if name not in _BACKDROPS and name not in backdrop_names():
        raise BadInput(
            f"is {name!r}",
            where=where,
            field="background",
            remedy=f"Known: {', '.join(backdrop_names())}.",
        )


@lru_cache(maxsize=2)
def _texture(name: str, seed: int) -> np.ndarray:
    """(T, T, 3) float32 linear, over slopes -1..1 in both directions."""
    import cv2

    if name not in _BACKDROPS:
        return plane_texture(name, seed)
    backdrop = _BACKDROPS[name]
    rng = generator(seed, "backdrop", name)
    ticks = np.linspace(-1.0, 1.0, _TEXTURE)
    x, y = np.meshgrid(ticks, ticks)
    points = np.stack([x.ravel(), 3.0 * y.ravel(), np.zeros(x.size)], axis=1)
    grain = fractal_noise(points * [1.0, 4.0, 1.0], 0.25, rng).reshape(x.shape)
    stain = fractal_noise(points, 0.5, rng).reshape(x.shape)
    wall = np.array(backdrop.wall) * (1.0 + 0.04 * stain + 0.1 * x)[..., None]
    table = np.array(backdrop.table) * (1.0 + 0.08 * grain)[..., None]
    image = np.clip(wall, 0.02, 1.0)
    for _ in range(backdrop.clutter):
        left, width = rng.uniform(-0.6, 0.55), rng.uniform(0.04, 0.2)
        bottom = backdrop.edge + rng.uniform(-0.02, 0.03)
        top = bottom - rng.uniform(0.06, 0.4)
        color = np.clip(rng.uniform(0.1, 0.85, 3) * 0.6 + 0.2 * rng.uniform(), 0.05, 0.9)
        inside = (x > left) & (x < left + width) & (y > top) & (y < bottom)
        shade = 1.0 + 0.25 * (x - left) / width
        image = np.where(inside[..., None], np.clip(color * shade[..., None], 0, 1), image)
    on_table = (y > backdrop.edge + 0.03 * x)[..., None]
    image = np.where(on_table, np.clip(table, 0.02, 1.0), image)
    linear = srgb_to_linear(image).astype(np.float32)
    return cv2.GaussianBlur(linear, (0, 0), 4.0)


def backdrop_colors(name: str, seed: int, directions: np.ndarray) -> np.ndarray:
    """The backdrop in each viewing direction, under white light.

    Takes `directions` (H, W, 3) world. Returns (H, W, 3) linear reflectance.
    """
    import cv2

    slope = directions[..., :2] / np.maximum(directions[..., 2:], 1e-3)
    slope += 1.0
    slope /= 2.0
    texture = _texture(name, seed)
    slope *= len(texture) - 1
    place = slope.astype(np.float32)
    return cv2.remap(
        texture,
        np.ascontiguousarray(place[..., 0]),
        np.ascontiguousarray(place[..., 1]),
        cv2.INTER_LINEAR,
        borderMode=cv2.BORDER_REPLICATE,
    )
