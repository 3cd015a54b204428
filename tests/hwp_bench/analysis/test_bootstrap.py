"""The bootstrap. Oracles: Student's t interval, arithmetic, simulation with a known truth."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy import stats

from benchmarks.coverage import STUDIES, Study, coverage, simulate
from hwp_bench.analysis.bootstrap import (
    FEWEST,
    bootstrap_mean,
    hall_transform,
    interval_reaches,
    inverse_hall_transform,
    least_extreme,
    make_blocks,
    skewness_of_mean,
)
from hwp_bench.base.errors import UsageError


def test_without_spread_in_captures_it_is_students_interval() -> None:
    """Values without a tail. Tolerance 2 %: the resampling of 20,000 draws."""
    values = np.array([0.3, 1.2, -0.2, 0.7, 0.5])
    estimate = bootstrap_mean([np.full((1, 6), value) for value in values], resamples=20_000)
    low, high = stats.t.interval(0.95, 4, values.mean(), stats.sem(values))
    assert estimate.value == pytest.approx(values.mean(), abs=1e-12)
    assert estimate.low == pytest.approx(low, abs=0.02 * (high - low))
    assert estimate.high == pytest.approx(high, abs=0.02 * (high - low))
    p = stats.ttest_1samp(values, 0).pvalue
    assert estimate.p == pytest.approx(p, rel=0.05)
    assert estimate.above == pytest.approx(1 - p / 2, rel=0.01)
    # Found with 80 %: beyond the end of the interval by the quantile of 0.8.
    reach = stats.t.ppf(0.975, 4) + stats.t.ppf(0.8, 4)
    assert estimate.detectable == pytest.approx(reach * stats.sem(values), rel=0.03)


def test_one_capture_of_several_seeds_has_students_interval_over_the_seeds() -> None:
    sample = np.repeat([[0.0], [1.0], [2.0]], 36, axis=1)  # six blocks of six frames
    estimate = bootstrap_mean([sample], resamples=20_000)
    low, high = stats.t.interval(0.95, 2, 1.0, stats.sem([0, 1, 2]))
    assert (estimate.low, estimate.high) == pytest.approx((low, high), abs=0.02 * (high - low))


def test_one_capture_of_one_seed_has_students_interval_over_its_blocks() -> None:
    values = np.random.default_rng(0).normal(1, 1, 100)
    blocks = np.mean([np.roll(values, -shift) for shift in range(10)], axis=0)
    estimate = bootstrap_mean([values[None]], resamples=20_000)
    reach = 2 * stats.t.ppf(0.975, 9) * blocks.std() / 3
    assert estimate.low is not None
    assert estimate.high is not None
    assert estimate.high - estimate.low == pytest.approx(reach, rel=0.03)


def test_spread_of_frames_and_seeds_is_counted_once() -> None:
    """Oracle: Student's interval of the capture means, which hold that spread already; 3 %.

    A tail moves one end of the interval out; the other is Student's.
    """
    random = np.random.default_rng(1)
    samples = [random.normal(0, 3, (3, 40)) + random.normal(0, 1, (3, 1)) for _ in range(8)]
    means = np.array([sample.mean() for sample in samples])
    estimate = bootstrap_mean(samples, resamples=20_000)
    low, high = stats.t.interval(0.95, 7, means.mean(), stats.sem(means))
    shorter = min(estimate.high - estimate.value, estimate.value - estimate.low)
    assert 2 * shorter == pytest.approx(high - low, rel=0.03)


def test_weights_move_the_mean_and_widen_the_interval() -> None:
    values = [np.full((1, 4), value) for value in (0.0, 1.0, 2.0, 3.0)]
    even = bootstrap_mean(values)
    uneven = bootstrap_mean(values, [1, 1, 1, 5])
    assert uneven.value == pytest.approx((0 + 1 + 2 + 15) / 8)
    assert even.value == 1.5
    assert uneven.high - uneven.low > even.high - even.low


def test_one_capture_speaks_of_its_frames_and_one_block_of_nothing() -> None:
    random = np.random.default_rng(0)
    estimate = bootstrap_mean([random.normal(1, 1, (1, 100))])
    assert estimate.captures == 1
    assert estimate.low < 1 < estimate.high
    assert estimate.high - estimate.low == pytest.approx(2 * 2.26 * 0.1, rel=0.4)
    silent = bootstrap_mean([np.array([[0.7]])])
    assert (silent.value, silent.low, silent.p) == (0.7, None, None)


def test_a_long_tail_moves_its_own_end_out() -> None:
    """Oracle: Student's reach on the other side; interval, p and P(better) say the same."""
    values = np.array([0.1, 0.2, 0.25, 0.3, 0.35, 3.0])
    estimate = bootstrap_mean([np.full((1, 6), value) for value in values], resamples=20_000)
    low, high = stats.t.interval(0.95, 5, values.mean(), stats.sem(values))
    assert estimate.low == pytest.approx(low, abs=0.02 * (high - low))
    assert estimate.high > high + 0.3 * (high - low)
    ended = bootstrap_mean([np.full((1, 6), v - estimate.high) for v in values], resamples=20_000)
    assert ended.p == pytest.approx(0.05, abs=1e-6)
    assert ended.above == pytest.approx(0.025, abs=1e-6)


def test_no_difference_at_all_is_certain() -> None:
    nothing = bootstrap_mean([np.zeros((1, 5))] * 3)
    assert (nothing.low, nothing.high, nothing.above, nothing.p) == (0, 0, 0.5, 1)
    always = bootstrap_mean([np.ones((1, 5))] * 3)
    assert (always.low, always.above, always.p) == (1, 1, 0)


@settings(max_examples=40, deadline=None)
@given(
    st.lists(st.lists(st.floats(-50, 50), min_size=1, max_size=12), min_size=2, max_size=6),
    st.integers(0, 3),
)
def test_it_repeats_and_turns_with_its_sign(rows: list[list[float]], seed: int) -> None:
    samples = [np.array([row]) for row in rows]
    estimate = bootstrap_mean(samples, resamples=200, seed=seed)
    assert estimate == bootstrap_mean(samples, resamples=200, seed=seed)
    turned = bootstrap_mean([-sample for sample in samples], resamples=200, seed=seed)
    assert turned.value == pytest.approx(-estimate.value)
    assert turned.low == pytest.approx(-estimate.high, abs=1e-9)
    assert estimate.low <= estimate.value <= estimate.high
    assert 0 <= estimate.p <= 1


def test_what_cannot_be_averaged_is_refused() -> None:
    for samples, weights in (
        ([], None),
        ([np.zeros((1, 0))], None),
        ([np.array([[np.nan]])], None),
        ([np.zeros(3)], None),
        ([np.zeros((1, 3))], [0.0]),
        ([np.zeros((1, 3))], [1.0, 2.0]),
    ):
        with pytest.raises(UsageError):
            bootstrap_mean(samples, weights)


def test_blocks_wrap_around_and_keep_the_mean() -> None:
    blocks = make_blocks(np.arange(9.0)[None])
    assert blocks.means.shape == (1, 9)
    assert blocks.means[0, 0] == pytest.approx(1.0)
    assert blocks.means[0, 8] == pytest.approx((8 + 0 + 1) / 3)
    assert blocks.value == pytest.approx(4.0)
    errors = blocks.errors(20_000, np.random.default_rng(0))
    assert errors.mean() == pytest.approx(0, abs=0.05)


def test_correlated_frames_spread_blocks_more_than_single_frames() -> None:
    samples = simulate(Study(1, 400, between=0.0, correlation=0.95), np.random.default_rng(0))
    shuffled = np.random.default_rng(1).permuted(samples[0], axis=1)
    assert make_blocks(samples[0]).variance > 3 * make_blocks(shuffled).variance


@pytest.mark.slow
@pytest.mark.parametrize("study", STUDIES, ids=str)
def test_the_interval_covers_as_often_as_it_says(study: Study) -> None:
    """Oracle: 800 simulated studies with true difference 0; the issue asks for 92 to 98 %.

    Three captures cannot show a tail; there an exponential one may take the interval to 90 %.
    """
    covered = coverage(study, repeats=800, resamples=300, seed=3).ours
    tailed = study.skewed and study.captures < FEWEST
    assert (0.90 if tailed else 0.92) <= covered <= 0.98


def test_the_textbook_interval_covers_too_rarely_with_few_captures() -> None:
    """Why the percentile interval is not used."""
    assert coverage(Study(3, 6), repeats=200, resamples=200).percentile < 0.85


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
