"""Which captures and metrics tell methods apart: statistics of the items of a benchmark.

For one capture and metric, x_ij is the mean over frames of method i with its j-th seed, of k
methods with n_i seeds, N in all. A one-way analysis of variance with random effects gives the mean
squares between methods, MB with k - 1 degrees of freedom, and within them, MW with N - k:

    within^2  = MW                               spread between seeds of one method
    between^2 = max(0, (MB - MW) / n0)           n0 = (N - sum(n_i^2) / N) / (k - 1)
    ratio     = between / within
    ICC       = between^2 / (between^2 + within^2)

Sources: Shrout and Fleiss, Intraclass correlations: uses in assessing rater reliability,
Psychological Bulletin 86(2), 1979, for ICC(1,1); Searle, Casella and McCulloch, Variance
Components, 1992, for n0. A ratio of 1 means that another seed moves a method as much as another
method does.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True)
class ItemStatistics:
    """How well one capture separates methods in one metric; None where that is undefined."""

    #: Id of the capture.
    capture: str
    #: Standard deviation of methods, the part of seeds taken off.
    between: float | None
    #: Standard deviation of seeds of one method; None where no method has several.
    within: float | None
    #: `between` over `within`.
    ratio: float | None
    #: Share of methods in the variance, 0 to 1: the intraclass correlation ICC(1,1).
    reliability: float | None
    #: Pearson correlation over methods with the mean of the other captures (item-rest correlation),
    #: -1 to 1; from three methods and two captures on.
    agreement: float | None
    #: Mean over seeds of the best method.
    best: float
    #: Share of the way from the score of a failed frame to the ceiling that `best` has gone.
    saturation: float | None


def variance_components(scores: Sequence[np.ndarray]) -> tuple[float | None, float | None]:
    """Standard deviations between methods and between seeds, from (n_i,) scores of each method."""
    counts = np.array([len(own) for own in scores])
    total, methods = int(counts.sum()), len(scores)
    if total == methods or methods < 2:
        return None, None
    averages = np.array([own.mean() for own in scores])
    inside = sum(float(((own - own.mean()) ** 2).sum()) for own in scores) / (total - methods)
    grand = float(np.concatenate(scores).mean())
    across = float((counts * (averages - grand) ** 2).sum()) / (methods - 1)
    size = (total - float((counts**2).sum()) / total) / (methods - 1)
    return math.sqrt(max(0.0, across - inside) / size), math.sqrt(inside)


def item_statistics(
    scores: Mapping[str, Sequence[np.ndarray]],
    ceilings: Mapping[str, float],
    floor: float,
    *,
    higher: bool,
) -> list[ItemStatistics]:
    """Return the statistics of every capture, in the order given.

    Args:
        scores: by capture, (n_i,) means over frames of each method's seeds, methods in one order.
        ceilings: by capture, the score that no method can pass.
        floor: the score of a failed frame.
        higher: whether larger scores are better.
    """
    averages = {name: np.array([own.mean() for own in every]) for name, every in scores.items()}
    found = []
    for name, every in scores.items():
        between, within = variance_components(every)
        variance = None if between is None or within is None else between**2 + within**2
        others = [averages[other] for other in averages if other != name]
        best = float(averages[name].max() if higher else averages[name].min())
        way = ceilings[name] - floor
        found.append(
            ItemStatistics(
                name,
                between,
                within,
                between / within if between is not None and within else None,
                between**2 / variance if between is not None and variance else None,
                _correlation(averages[name], np.mean(others, axis=0)) if others else None,
                best,
                (best - floor) / way if way else None,
            )
        )
    return found


def _correlation(first: np.ndarray, second: np.ndarray) -> float | None:
    if len(first) < 3 or np.ptp(first) == 0.0 or np.ptp(second) == 0.0:
        return None
    return float(np.corrcoef(first, second)[0, 1])
