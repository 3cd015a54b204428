"""Corrections of a predicted frame that only its truth can give: oracles at test time.

Each removes as much of one kind of error as a few numbers can: light as a gain of linear light,
place as a motion of the image, pose as a motion of the posed surface. The gain of a correction is
the cost of that kind of error. The parameters are found by Gauss-Newton steps on the squared error
in sRGB, which PSNR counts.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace
from types import MappingProxyType

import cv2
import numpy as np

from hwp_bench.base.colors import harmonics, linear_to_srgb, srgb_to_linear
from hwp_bench.evaluation.budget.surface import Pair, error_of

# Steps of Gauss-Newton; all corrections have come to rest by then.
_STEPS = 10
# Times that a step is halved before the search ends.
_HALVINGS = 4
# Weight that draws parameters to no correction, as a share of the mean squared derivative.
_RIDGE = 1e-4
# Largest logarithm of a gain: a factor of 20.
_LARGEST = 3.0
# Cells along each edge of the finest gain.
_CELLS = 12
# Derivative of sRGB is taken at this light and above; it grows without bound towards black.
_DARK = 2e-3
# Squared error, as a share of what there is, that a parameter must take away before it moves by
# its own scale. See `pose`.
_PRICE = 0.01


# --- light


def gain(pair: Pair) -> np.ndarray:
    """One gain of each channel: exposure and white balance. Returns the image (H, W, 3)."""
    return _relit(pair, np.ones((*pair.region.shape, 1)))


def light(pair: Pair) -> np.ndarray:
    """A gain that is a function of the normal, with harmonics up to degree 2: another light."""
    return _relit(pair, harmonics(pair.normals))


def gain_map(pair: Pair) -> np.ndarray:
    """A gain on a grid of 12 x 12 over the hand's box: all that is smooth in the image."""
    rows, columns = np.nonzero(pair.region)
    top, left = rows.min(), columns.min()
    height, width = rows.max() - top + 1, columns.max() - left + 1
    identity = np.eye(_CELLS**2).reshape(-1, _CELLS, _CELLS).transpose(1, 2, 0)
    basis = np.zeros((*pair.region.shape, _CELLS**2))
    # OpenCV resamples a few channels at a time only.
    for start in range(0, _CELLS**2, 4):
        basis[top : top + height, left : left + width, start : start + 4] = cv2.resize(
            np.ascontiguousarray(identity[..., start : start + 4]), (int(width), int(height))
        ).reshape(height, width, -1)
    return _relit(pair, basis)


def _relit(pair: Pair, basis: np.ndarray) -> np.ndarray:
    """The prediction with its light multiplied by exp(basis @ c), c for each channel."""
    inner = basis[pair.region]
    light_of = srgb_to_linear(pair.prediction)
    result = pair.prediction.copy()
    for channel in range(3):
        dark, truth = light_of[..., channel][pair.region], pair.target[..., channel][pair.region]

        def lit(logs: np.ndarray, dark: np.ndarray = dark) -> np.ndarray:
            return dark * np.exp(np.clip(inner @ logs, -_LARGEST, _LARGEST))

        def error(logs: np.ndarray, truth: np.ndarray = truth) -> float:
            return float(((linear_to_srgb(lit(logs)) - truth) ** 2).sum())

        def step(logs: np.ndarray, truth: np.ndarray = truth) -> np.ndarray:
            now = lit(logs)
            way = least_squares((_slope(now) * now)[:, None] * inner, truth - linear_to_srgb(now))
            # sRGB is far from linear in the logarithm: no pixel goes further than e at a time.
            return way / max(float(np.abs(inner @ way).max()), 1.0)

        best = least_error(error, step, np.zeros(basis.shape[-1]))
        factor = np.exp(np.clip(basis @ best, -_LARGEST, _LARGEST))
        result[..., channel] = linear_to_srgb(light_of[..., channel] * factor)
    return result


def _slope(light: np.ndarray) -> np.ndarray:
    """Derivative of sRGB by linear light; 0 where the image is saturated."""
    curved = 1.055 / 2.4 * np.maximum(light, _DARK) ** (1.0 / 2.4 - 1.0)
    return np.where(light >= 1.0, 0.0, curved)


# --- place and pose


def motion(pair: Pair) -> np.ndarray:
    """An affine motion of the image: what a wrong place, turn or size of the hand comes to."""
    height, width = pair.region.shape
    columns, rows = np.meshgrid(np.arange(width, dtype=np.float64), np.arange(height))
    centre = np.array([columns[pair.region].mean(), rows[pair.region].mean()])
    scale = float(np.sqrt(np.count_nonzero(pair.region)))
    x, y = (columns - centre[0]) / scale, (rows - centre[1]) / scale
    # Each row moves x and y by a share of these; px for the first, px at the hand's border else.
    shapes = np.stack([np.ones_like(x), x, y], axis=-1)
    source = pair.prediction.astype(np.float32)

    def moved(ways: np.ndarray) -> np.ndarray:
        dx, dy = np.einsum("hwk,ck->chw", shapes, ways)
        across, down = (way.astype(np.float32) for way in (columns + dx, rows + dy))
        return cv2.remap(source, across, down, cv2.INTER_LINEAR).astype(np.float64)

    def derivative(image: np.ndarray) -> np.ndarray:
        across, down = np.gradient(image, axis=1), np.gradient(image, axis=0)
        both = np.stack([across, down], axis=2)[pair.region]
        moves = np.einsum("pcj,pk->pjck", both, shapes[pair.region])
        return moves.reshape(len(both), 3, -1)

    def error(ways: np.ndarray) -> float:
        return error_of(moved(ways.reshape(2, 3)), pair)

    def step(ways: np.ndarray) -> np.ndarray:
        image = moved(ways.reshape(2, 3))
        return least_squares(derivative(image), (pair.target - image)[pair.region])

    ways = least_error(error, step, np.zeros(6))
    return moved(ways.reshape(2, 3)) if ways.any() else pair.prediction


def pose(pair: Pair) -> np.ndarray:
    """Another pose: the image moves with the estimated hands' surface.

    Every joint turns and every hand is displaced. A parameter moves by its own scale
    (`MovingSurface.scales`) only where that takes away 1 % of the squared error: a joint that the
    image does not determine stays still, and pixels that nothing moves right are left to other
    rows.
    """
    surface = pair.surface
    if surface is None:
        return pair.prediction
    source = pair.prediction.astype(np.float32)
    scales = surface.scales
    price = _PRICE * max(pair.error, 1e-12)

    def moved(ways: np.ndarray) -> np.ndarray:
        across, down = np.moveaxis(surface.sources(ways * scales), -1, 0)
        return cv2.remap(source, across, down, cv2.INTER_LINEAR).astype(np.float64)

    def error(ways: np.ndarray) -> float:
        return error_of(moved(ways), pair) + price * float(ways @ ways)

    def step(ways: np.ndarray) -> np.ndarray:
        image = moved(ways)
        slopes = np.stack([np.gradient(image, axis=1), np.gradient(image, axis=0)], axis=-1)
        # A surface that moves by u takes the image with it: the pixel gets less of what is ahead.
        moves = -surface.moves(ways * scales, pair.region) * scales
        flat = (slopes[pair.region] @ moves).reshape(-1, len(ways))
        rest = (pair.target - image)[pair.region].reshape(-1)
        normal = flat.T @ flat / len(flat) + price * np.eye(len(ways))
        way: np.ndarray = np.linalg.solve(normal, flat.T @ rest / len(flat) - price * ways)
        return way

    ways = least_error(error, step, np.zeros(len(scales)))
    return moved(ways) if ways.any() else pair.prediction


def motion_and_light(pair: Pair) -> np.ndarray:
    """A motion, and then another light."""
    return light(replace(pair, prediction=motion(pair)))


# --- Gauss-Newton steps


def least_error(
    error: Callable[[np.ndarray], float],
    step: Callable[[np.ndarray], np.ndarray],
    start: np.ndarray,
) -> np.ndarray:
    """Parameters (K,) of a small error, by steps that are halved until the error falls."""
    best, least = start, error(start)
    for _ in range(_STEPS):
        way = step(best)
        for _ in range(_HALVINGS):
            found = error(best + way)
            if found < least:
                best, least = best + way, found
                break
            way = 0.5 * way
        else:
            break
    return best


def least_squares(derivatives: np.ndarray, rest: np.ndarray) -> np.ndarray:
    """The least squares step: (K,) from derivatives (..., K) and what is missing (...)."""
    flat = derivatives.reshape(-1, derivatives.shape[-1])
    normal = flat.T @ flat
    ridge = _RIDGE * max(float(np.trace(normal)) / len(normal), 1e-12)
    found: np.ndarray = np.linalg.solve(normal + ridge * np.eye(len(normal)), flat.T @ rest.ravel())
    return found


#: The corrections by name, with what each of them takes away.
CORRECTIONS: Mapping[str, tuple[Callable[[Pair], np.ndarray], str]] = MappingProxyType(
    {
        "gain": (gain, "one gain a channel and frame: exposure, white balance"),
        "light": (light, "a gain by the normal, degree 2: the light of the frame"),
        "motion": (motion, "an affine motion of the image: place, turn and size of the hand"),
        "pose": (pose, "every joint's rotation and the translation: the pose of the frame"),
        "motion+light": (motion_and_light, "an affine motion, then another light"),
        "gain map": (gain_map, "a gain on a 12 x 12 grid: everything smooth"),
    }
)
