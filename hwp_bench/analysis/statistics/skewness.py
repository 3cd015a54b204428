"""What a long tail of the captures' differences does to an interval that is read with Student's t.

With exponential differences of a few captures Student's interval covers too rarely: they seldom
show the tail, and then both the mean and the spread are small. Hall's transformation moves both
ends towards the tail. An interval that reaches as far as either of the two covers often enough, and
where nothing is skewed not much too often (`python -m hwp_bench.analysis.statistics.coverage`).
"""

from __future__ import annotations

import numpy as np

#: Fewest captures whose skewness is looked at: three points lean to a side in any case.
FEWEST = 4


def skewness_of_mean(values: np.ndarray, share: np.ndarray) -> float:
    """Return the estimated skewness of a weighted mean over captures.

    Args:
        values: (N,) float, the captures' means.
        share: (N,) float, their weights, adding up to 1.

    Returns:
        Sum of w^3 over (sum of w^2)^1.5, times the captures' own skewness; with equal weights
        that is the skewness over the square root of N. 0 below `FEWEST` captures, and where
        nothing varies.
    """
    deviations = values - share @ values
    spread = share @ deviations**2
    # Differences that differ by rounding alone have no shape.
    if len(values) < FEWEST or spread <= (1e-12 * np.abs(values).max()) ** 2:
        return 0.0
    own = share @ deviations**3 / spread**1.5
    return float(own * (share**3).sum() / (share**2).sum() ** 1.5)


def bent(studentised: float, skew: float) -> float:
    """Return Hall's transformation of a Student statistic, which takes the skewness out of it.

    T + k T^2 / 3 + k^2 T^3 / 27 + k / 6, increasing in T.

    Args:
        studentised: the mean less the truth, over its standard error: T.
        skew: skewness of the mean: k.

    Source: Hall, On the removal of skewness by transformation, 1992, with the constants for a
    studentised mean (a = 1/3, b = 1/6).
    """
    return studentised + skew * studentised**2 / 3 + skew**2 * studentised**3 / 27 + skew / 6


def straightened(value: float, skew: float) -> float:
    """Return the inverse of `bent` in its first argument."""
    if abs(skew) < 1e-9:
        return value
    return float(3 / skew * (np.cbrt(1 + skew * (value - skew / 6)) - 1))


def reaches(quantile: float, skew: float) -> tuple[float, float]:
    """Return how far an interval reaches below and above the mean, in standard errors.

    Args:
        quantile: of Student's t, above 0.
        skew: skewness of the mean.

    Returns:
        The larger of Student's reach and that after Hall's transformation, on each side.
    """
    below = max(quantile, straightened(quantile, skew))
    return below, max(quantile, -straightened(-quantile, skew))


def nearest_to_even(first: float, second: float) -> float:
    """Return of two probabilities the one that claims less: 0.5 where they contradict."""
    low, high = sorted((float(first), float(second)))
    return min(max(0.5, low), high)
