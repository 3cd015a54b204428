"""The correction for long tails. Oracles: scipy, inversion, symmetry."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy import stats

from hwp_bench.analysis.statistics.bootstrap import (
    hall_transform,
    interval_reaches,
    inverse_hall_transform,
    least_extreme,
    skewness_of_mean,
)

SKEWS = st.floats(-1, 1)


def test_the_skewness_is_that_of_a_mean() -> None:
    values = np.random.default_rng(0).exponential(size=9)
    even = np.full(9, 1 / 9)
    assert skewness_of_mean(values, even) == pytest.approx(stats.skew(values) / 3)
    assert skewness_of_mean(-values, even) == pytest.approx(-stats.skew(values) / 3)
    # One capture that weighs nearly everything leaves the mean with its own shape.
    heavy = np.array([0.97, *[0.03 / 8] * 8])
    own = heavy @ (values - heavy @ values) ** 3 / (heavy @ (values - heavy @ values) ** 2) ** 1.5
    assert skewness_of_mean(values, heavy) == pytest.approx(own, rel=0.01)


def test_what_has_no_shape_has_no_skewness() -> None:
    assert skewness_of_mean(np.array([0.0, 0.0, 9.0]), np.full(3, 1 / 3)) == 0
    assert skewness_of_mean(np.full(5, 0.1), np.full(5, 0.2)) == 0
    assert skewness_of_mean(np.zeros(5), np.full(5, 0.2)) == 0


@given(st.floats(-30, 30), SKEWS)
def test_bending_is_undone(value: float, skew: float) -> None:
    """Tolerance: the cube root loses digits where the curve is flat."""
    assert hall_transform(inverse_hall_transform(value, skew), skew) == pytest.approx(
        value, abs=1e-5
    )


@given(st.floats(-10, 10), st.floats(0, 5), SKEWS)
def test_bending_keeps_the_order(value: float, more: float, skew: float) -> None:
    assert hall_transform(value + more, skew) >= hall_transform(value, skew) - 1e-9


@given(st.floats(1.9, 5), SKEWS)
def test_the_interval_only_grows_and_turns_with_the_sign(quantile: float, skew: float) -> None:
    below, above = interval_reaches(quantile, skew)
    assert min(below, above) >= quantile
    assert interval_reaches(quantile, -skew) == pytest.approx((above, below))
    if abs(skew) > 0.01:
        assert (above > below) == (skew > 0)
    assert interval_reaches(quantile, 0.0) == (quantile, quantile)


def test_of_two_probabilities_the_weaker_holds() -> None:
    assert least_extreme(0.9, 0.97) == 0.9
    assert least_extreme(0.01, 0.2) == 0.2
    assert least_extreme(0.4, 0.6) == 0.5
