"""Errors of a tracker's landmarks, as measured on a real clip: per landmark, over time, by pose.

All numbers are printed by `python -m benchmarks.tracker_errors --video VIDEO --landmarks NPZ` on a
video of 621 frames with MediaPipe's landmarks. There is no truth in it: what counts as an error of
a landmark is its distance from the whole clip's fit, less the mean of the clip. The fit was that of
version 1 of the importer; later versions give other numbers, and scenes keep these.
"""

from __future__ import annotations

import numpy as np

# fmt: off
#: Standard deviation of each landmark in the image, shares of the hand's extent, one axis.
IMAGE_SPREAD: tuple[float, ...] = (
    0.0120,
    0.0111, 0.0073, 0.0065, 0.0085,
    0.0087, 0.0081, 0.0057, 0.0126,
    0.0075, 0.0084, 0.0065, 0.0092,
    0.0071, 0.0105, 0.0099, 0.0098,
    0.0060, 0.0101, 0.0099, 0.0097,
)
#: Standard deviation of each world landmark against the hand's centre, m, mean of the axes.
WORLD_SPREAD: tuple[float, ...] = (
    0.0072,
    0.0052, 0.0055, 0.0072, 0.0112,
    0.0043, 0.0044, 0.0046, 0.0055,
    0.0033, 0.0033, 0.0047, 0.0063,
    0.0037, 0.0034, 0.0041, 0.0060,
    0.0055, 0.0044, 0.0045, 0.0060,
)
# fmt: on
#: Share of each camera axis in it: a tracker errs most along the line of sight.
WORLD_AXES: tuple[float, float, float] = (0.68, 0.48, 1.52)
#: Growth of both: at rest facing the camera, more at a full curl, more seen from the edge; 1 is the
#: mean of the clip.
GROWTH: tuple[float, float, float] = (0.41, 1.64, 1.28)
#: Time scale of the errors that a fit keeps, s: its smoothness removes what is faster.
MEMORY = 0.14
#: Share of the variance that never changes in a capture.
HABIT = 0.18
# Numbers of one landmark: two in the image and three in the world.
_NUMBERS = 5


def growth(curl: np.ndarray, edge_on: np.ndarray) -> np.ndarray:
    """Size of the errors against the clip's mean: (F,), of curl (F,) and edge-on view (F,)."""
    still, bent, turned = GROWTH
    return np.asarray(still + bent * curl + turned * edge_on)


def landmark_noise(
    rng: np.random.Generator, frames: int, step: float, habit: float = HABIT
) -> np.ndarray:
    """Unit noise of 21 landmarks: (F, 21, 5), x and y in the image, then x, y, z in the world.

    Args:
        rng: source of random numbers.
        frames: number of frames.
        step: seconds between two.
        habit: share of the variance that is the same in all frames.
    """
    size = (21, _NUMBERS)
    constant = rng.normal(size=size)
    moving = wandering(rng, frames, step, 21 * _NUMBERS).reshape(frames, *size)
    return np.asarray(np.sqrt(1.0 - habit) * moving + np.sqrt(habit) * constant)


def wandering(rng: np.random.Generator, frames: int, step: float, width: int) -> np.ndarray:
    """Smooth noise of unit variance: (F, width), correlated by (1 + t / m) exp(-t / m).

    Args:
        rng: source of random numbers.
        frames: number of frames.
        step: seconds between two; any, the correlation is that of the time between them.
        width: independent channels.

    Source: the Matern process of order 3/2 as a linear state of value and slope, sampled exactly
    (Hartikainen and Sarkka, 2010), with m = `MEMORY`.
    """
    rate = 1.0 / MEMORY
    turn = np.exp(-rate * step) * np.array(
        [[1.0 + rate * step, step], [-rate * rate * step, 1.0 - rate * step]]
    )
    steady = np.diag([1.0, rate * rate])
    values, vectors = np.linalg.eigh(steady - turn @ steady @ turn.T)
    spread = vectors * np.sqrt(np.maximum(values, 0.0))
    state = np.sqrt(steady) @ rng.normal(size=(2, width))
    walk = np.empty((frames, width))
    for frame in range(frames):
        if frame:
            state = turn @ state + spread @ rng.normal(size=(2, width))
        walk[frame] = state[0]
    return walk
