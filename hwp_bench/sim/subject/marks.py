"""Marks on skin: freckles, wrinkles and hair, as functions of the place on the rest hand."""

from __future__ import annotations

import numpy as np

from hwp_bench.base.numerics import kd_tree
from hwp_bench.sim.geometry.mesh import unit
from hwp_bench.sim.geometry.noise import fractal_noise

# Freckles lie one to a cell of a grid that fills this box around hand and forearm, m.
_CELL = 0.0031
_BOX = np.array([[-0.24, 0.34], [-0.09, 0.09], [-0.12, 0.12]])
# Hairs on a square centimetre of the back of the hand where hair is 1.
_HAIRS = 26.0
# Steps of a hair along the skin, and their length in m.
_STEPS, _STEP = 32, 0.0003


def freckles(points: np.ndarray, amount: float, rng: np.random.Generator) -> np.ndarray:
    """Round spots of 0.4 to 1.4 mm: (N,), 0 outside and up to 1 inside a spot.

    Args:
        points: (N, 3) m on the rest hand.
        amount: 0 to 1, share of the places that carry one.
        rng: decides which, where and how dark.
    """
    ticks = [np.arange(low, high, _CELL) for low, high in _BOX]
    cells = np.stack(np.meshgrid(*ticks, indexing="ij"), axis=-1).reshape(-1, 3)
    centers = cells + rng.uniform(0.0, _CELL, cells.shape)
    radius = 0.0004 + 0.001 * rng.uniform(size=len(cells)) ** 3
    depth = rng.uniform(0.3, 1.0, len(cells))
    there = rng.uniform(size=len(cells)) < 0.85 * amount
    low, high = points.min(axis=0) - _CELL, points.max(axis=0) + _CELL
    there &= np.all((centers > low) & (centers < high), axis=1)
    if not there.any():
        return np.zeros(len(points))
    distance, nearest = kd_tree(centers[there]).query(points, distance_upper_bound=0.003)
    near = np.isfinite(distance)
    spots = np.zeros(len(points))
    own = nearest[near]
    reach = 1.25 - distance[near] / radius[there][own]
    spots[near] = depth[there][own] * np.clip(2.0 * reach, 0.0, 1.0)
    return spots


def wrinkles(points: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """A net of fine folds, mostly across the fingers' direction: (N,), 0-1.

    Args:
        points: (N, 3) m on the rest hand.
        rng: decides where they run.
    """
    stretched = points * np.array([1.7, 0.8, 0.8])
    folds = np.zeros(len(points))
    for scale, strength in ((0.012, 1.0), (0.006, 0.6)):
        level = fractal_noise(stretched, scale, rng, octaves=2)
        folds = np.maximum(folds, strength * np.exp(-((level / 0.13) ** 2)))
    return folds


def hair(
    points: np.ndarray,
    normals: np.ndarray,
    share: np.ndarray,
    amount: float,
    rng: np.random.Generator,
) -> np.ndarray:
    """Fine strokes that follow the skin towards the finger tips and the little finger's side.

    Args:
        points: (N, 3) m on the rest hand, dense: neighbours at most 0.5 mm apart.
        normals: (N, 3) unit.
        share: (N,) 0-1, how much of the full growth a place has.
        amount: 0 to 1.
        rng: decides where the hairs start and how they bend.

    Returns:
        (N,) 0 (none) to 1 (covered by hair).
    """
    strokes = np.zeros(len(points))
    total = float(share.sum())
    if total <= 0.0:
        return strokes
    tree = kd_tree(points)
    probe = rng.integers(0, len(points), 400)
    spacing = float(np.median(tree.query(points[probe], k=2)[0][:, 1]))
    count = int(amount * _HAIRS * 1e4 * total * spacing**2)
    at = rng.choice(len(points), size=count, p=share / total)
    sway = fractal_noise(points, 0.03, rng, octaves=2)
    bend = sway[at] * 0.5 + rng.normal(0.0, 0.35, count)
    length = rng.uniform(0.35, 1.0, count) * (0.4 + 0.6 * share[at])
    curl = rng.normal(0.0, 0.035, count)
    darkness = rng.uniform(0.5, 1.0, count)
    place = points[at]
    for step in range(_STEPS):
        growing = step < length * _STEPS
        taper = darkness * (1.0 - 0.6 * step / (length * _STEPS))
        np.maximum.at(strokes, at[growing], taper[growing])
        angle = bend + curl * step
        way = np.stack([-np.cos(angle - 0.75), np.zeros(count), np.sin(angle - 0.75)], axis=1)
        normal = normals[at]
        way = unit(way - np.einsum("ni,ni->n", way, normal)[:, None] * normal)
        place = place + _STEP * way
        _, at = tree.query(place)
        # Back onto the skin, or the stroke would leave it where it curves.
        height = np.einsum("ni,ni->n", place - points[at], normals[at])
        place = place - height[:, None] * normals[at]
    # None walks on to where hair does not grow.
    return np.where(share > 0.0, strokes, 0.0)
