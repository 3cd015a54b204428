"""Robust location: the densest part of a set of values, where most frames agree."""

from __future__ import annotations

import numpy as np


def densest(values: np.ndarray, share: float) -> tuple[np.ndarray, np.ndarray]:
    """Find the values that lie closest together.

    The value whose `share` nearest values are nearest to it is the middle; they are the part.

    Args:
        values: (F, K) float, finite; F at least 1.
        share: part of the values that must agree, in (0, 1].

    Returns:
        (K,) mean of the part, and (F,) bool which values it holds.
    """
    count = min(len(values), max(2, round(share * len(values))))
    squares = (values**2).sum(axis=1)
    distance = squares[:, None] + squares[None] - 2.0 * values @ values.T
    radius = np.partition(distance, count - 1, axis=1)[:, count - 1]
    nearest = np.argsort(distance[int(np.argmin(radius))], kind="stable")[:count]
    part = np.zeros(len(values), dtype=bool)
    part[nearest] = True
    return values[part].mean(axis=0), part


def normal_value(values: np.ndarray, share: float) -> tuple[float, float]:
    """Median and robust deviation of the shortest part of the values: those that are normal.

    Args:
        values: (F,) float; those that are not finite are left out.
        share: part of the values that is normal at least, in (0, 1].

    Returns:
        Both 0 where no value is finite.
    """
    known = np.sort(values[np.isfinite(values)])
    if not len(known):
        return 0.0, 0.0
    count = min(len(known), max(2, round(share * len(known))))
    width = known[count - 1 :] - known[: len(known) - count + 1]
    start = int(np.argmin(width))
    normal = float(np.median(known[start : start + count]))
    # Half of the shortest part that holds a share s of a normal distribution is z(s) deviations.
    return normal, 0.5 * float(width[start]) / _half_width(count / len(known))


def excess(values: np.ndarray, share: float, floor: float) -> np.ndarray:
    """How far values lie above what is normal among them, in robust deviations.

    Args:
        values: (F,) float; not finite counts as normal.
        share: part of the values that is normal at least.
        floor: least deviation that counts as one, positive.

    Returns:
        (F,) float64, 0 where a value is not above normal.
    """
    normal, deviation = normal_value(values, share)
    above = np.maximum(values - normal, 0.0) / max(deviation, floor)
    return np.where(np.isfinite(values), above, 0.0)


def _half_width(share: float) -> float:
    """Deviations to either side of the mean that hold a share of a normal distribution."""
    from scipy.special import ndtri

    return float(ndtri(0.5 + 0.5 * min(share, 0.99)))
