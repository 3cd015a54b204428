"""Clutter that drifts past: boxes, balls and bars out of focus, as functions of place and time."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from hwp_bench.base.colors import srgb_to_linear
from hwp_bench.sim.geometry.noise import generator
from hwp_bench.sim.props.blobs import paint

# Share of the objects in colours of skin, and the ends of those colours in sRGB.
_SKIN_LIKE = 0.34
_SKINS = np.array([[0.92, 0.75, 0.62], [0.45, 0.30, 0.21]])
# Width over which objects drift before they come back at the other border, and their soft edge.
_WIDE, _SOFT = 3.4, 0.05


@dataclass(frozen=True, eq=False)
class _Thing:
    """One object: half sizes, roundness, colour, and how it moves."""

    half: np.ndarray
    round: float
    color: np.ndarray
    start: np.ndarray
    speed: np.ndarray
    angle: float
    spin: float
    phase: float


@lru_cache(maxsize=4)
def _things(count: int, seed: int) -> tuple[_Thing, ...]:
    rng = generator(seed, "clutter")
    things = []
    for _ in range(count):
        color = rng.uniform(0.08, 0.9, 3)
        if rng.uniform() < _SKIN_LIKE:
            share = rng.uniform()
            color = _SKINS[0] + share * (_SKINS[1] - _SKINS[0])
        size = rng.uniform(0.10, 0.32)
        kind = int(rng.integers(3))
        ratio = (rng.uniform(0.6, 1.0), 1.0, rng.uniform(0.16, 0.3))[kind]
        way = rng.choice([-1.0, 1.0]) * rng.uniform(0.4, 1.6)
        things.append(
            _Thing(
                half=np.array([size, size * ratio]),
                round=(0.02, size, 0.9 * size * ratio)[kind],
                color=srgb_to_linear(np.array(color)),
                start=rng.uniform(-1.0, 1.0, 2) * [_WIDE / 2.0, 0.85],
                speed=np.array([way, rng.normal(0.0, 0.2)]),
                angle=rng.uniform(0.0, 2.0 * np.pi),
                spin=rng.normal(0.0, 1.2),
                phase=rng.uniform(0.0, 2.0 * np.pi),
            )
        )
    return tuple(things)


def draw_clutter(
    image: np.ndarray,
    places: tuple[np.ndarray, np.ndarray],
    seconds: float,
    *,
    count: int,
    speed: float,
    seed: int,
) -> None:
    """Draw the clutter of a moment into an image.

    Args:
        image: (H, W, 3) linear, is changed.
        places: x and y (H, W) of the pixels, in halves of the picture.
        seconds: time of the capture.
        count: how many objects.
        speed: halves of the picture a second.
        seed: which objects.
    """
    for thing in _things(count, seed):
        way = thing.start + seconds * speed * thing.speed
        x = (way[0] + _WIDE / 2.0) % _WIDE - _WIDE / 2.0
        y = thing.start[1] + 0.12 * np.sin(2.0 * speed * seconds + thing.phase)
        turn = thing.angle + speed * thing.spin * seconds

        def cover(
            right: np.ndarray, down: np.ndarray, thing: _Thing = thing, turn: float = turn
        ) -> tuple[np.ndarray, np.ndarray]:
            cosine, sine = np.cos(turn), np.sin(turn)
            a = np.abs(cosine * right + sine * down) - thing.half[0] + thing.round
            b = np.abs(cosine * down - sine * right) - thing.half[1] + thing.round
            outside = np.hypot(np.maximum(a, 0.0), np.maximum(b, 0.0))
            distance = outside + np.minimum(np.maximum(a, b), 0.0) - thing.round
            shade = 0.75 - 0.35 * (right + 1.4 * down) / thing.half[0]
            return np.clip(0.5 - distance / _SOFT, 0.0, 1.0), np.clip(shade, 0.25, 1.3)

        paint(image, places, (x, y), 1.45 * thing.half.max() + _SOFT, thing.color, cover)
