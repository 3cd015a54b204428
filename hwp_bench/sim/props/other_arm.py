"""Another forearm with a closed hand behind the scene: rounded limbs, lit from above."""

from __future__ import annotations

import numpy as np

from hwp_bench.sim.geometry.mesh import unit
from hwp_bench.sim.geometry.noise import generator
from hwp_bench.sim.props.blobs import paint

# Limbs from elbow to fist as rows of (along, across, along, across, radius, radius), in halves of
# the picture; the wrist is the origin.
_LIMBS = (
    (-2.4, 0.0, -0.9, 0.0, 0.34, 0.26),
    (-0.95, 0.0, 0.0, 0.0, 0.265, 0.165),
    (-0.02, 0.0, 0.20, 0.0, 0.17, 0.21),
    (0.16, -0.13, 0.36, -0.13, 0.085, 0.08),
    (0.16, -0.045, 0.40, -0.045, 0.085, 0.08),
    (0.16, 0.045, 0.40, 0.045, 0.085, 0.08),
    (0.16, 0.13, 0.35, 0.13, 0.08, 0.075),
    (0.05, -0.18, 0.24, -0.20, 0.085, 0.07),
)
_SOFT = 0.035
_LIGHT = unit(np.array([-0.35, -0.75, 0.56]))


def draw_arm(
    image: np.ndarray,
    places: tuple[np.ndarray, np.ndarray],
    seconds: float,
    color: np.ndarray,
    *,
    left: bool,
    reach: float,
    sway: float,
    pace: float,
    seed: int,
) -> None:
    """Draw the arm of a moment into an image.

    Args:
        image: (H, W, 3) linear, is changed.
        places: x and y (H, W) of the pixels, in halves of the picture.
        seconds: time of the capture.
        color: (3,) linear reflectance of the skin.
        left: whether it comes from the left border.
        reach: how far the wrist is inside the border, in the mean.
        sway: how far it moves.
        pace: rounds of its motion a second.
        seed: phases, and the height at which it comes in.
    """
    rng = generator(seed, "other arm")
    phases = rng.uniform(0.0, 2.0 * np.pi, 3)
    turn = 2.0 * np.pi * pace * seconds
    side = -1.0 if left else 1.0
    inside = reach + sway * np.sin(turn + phases[0])
    lift = rng.uniform(-0.05, 0.45) + 0.6 * sway * np.sin(0.73 * turn + phases[1])
    angle = rng.uniform(-0.5, 0.05) + 0.5 * sway * np.sin(1.31 * turn + phases[2])
    along = np.array([-side * np.cos(angle), np.sin(angle)])
    across = np.array([-along[1], along[0]]) * -side
    wrist = np.array([side * (1.0 - inside), lift])
    for a0, c0, a1, c1, r0, r1 in _LIMBS:
        start = wrist + a0 * along + c0 * across
        end = wrist + a1 * along + c1 * across
        _limb(image, places, start, end, (r0, r1), color)


def _limb(
    image: np.ndarray,
    places: tuple[np.ndarray, np.ndarray],
    start: np.ndarray,
    end: np.ndarray,
    radius: tuple[float, float],
    color: np.ndarray,
) -> None:
    """A tapered limb with round ends, shaded as if it were a body."""
    middle, way = 0.5 * (start + end), end - start
    square = float(way @ way)

    def cover(right: np.ndarray, down: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        x, y = right + middle[0] - start[0], down + middle[1] - start[1]
        through = np.clip((x * way[0] + y * way[1]) / square, 0.0, 1.0)
        width = radius[0] + through * (radius[1] - radius[0])
        off_x, off_y = (x - through * way[0]) / width, (y - through * way[1]) / width
        out = np.hypot(off_x, off_y)
        front = np.sqrt(np.clip(1.0 - out * out, 0.0, 1.0))
        facing = off_x * _LIGHT[0] + off_y * _LIGHT[1] + front * _LIGHT[2]
        shade = 0.36 + 0.70 * np.clip((facing + 0.2) / 1.2, 0.0, None)
        return np.clip(0.5 + (1.0 - out) * width / _SOFT, 0.0, 1.0), shade

    far = 0.5 * np.sqrt(square) + max(radius) + _SOFT
    paint(image, places, (float(middle[0]), float(middle[1])), far, color, cover)
