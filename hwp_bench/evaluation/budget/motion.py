"""Corrections of place: an affine motion of the image, and another pose of the hands."""

from __future__ import annotations

import cv2
import numpy as np

from hwp_bench.evaluation.budget.least_squares import least_error, least_squares
from hwp_bench.evaluation.budget.pair import Pair, error_of

# Squared error, as a share of what there is, that a parameter must take away before it moves by
# its own scale. See `pose`.
_PRICE = 0.01


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
        return cv2.remap(
            source,
            (columns + dx).astype(np.float32),
            (rows + dy).astype(np.float32),
            cv2.INTER_LINEAR,
        ).astype(np.float64)

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
    image does not tell stays still, and pixels that nothing moves right are left to other rows.

    Returns:
        The image (H, W, 3); the prediction where no hand is known or nothing is better.
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
