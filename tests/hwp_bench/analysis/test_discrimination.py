"""Item statistics against the analysis of variance of SciPy and against known spreads."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.stats import f_oneway

from hwp_bench.analysis.discrimination import item_statistics, variance_components
from hwp_bench.analysis.pairing import group_runs
from hwp_bench.base.errors import UsageError
from hwp_bench.report.study_tables import discrimination_table
from tests.made_results import made_results


def test_components_are_those_of_the_analysis_of_variance() -> None:
    """Oracle: SciPy's F is MB / MW, so that between^2 = (F - 1) MW / n for equal n."""
    rng = np.random.default_rng(0)
    scores = list(rng.normal(0.0, 1.0, (6, 3)) + 2.0 * np.arange(6)[:, None])
    between, within = variance_components(scores)
    assert between is not None
    assert within is not None
    assert within**2 == pytest.approx(np.mean([own.var(ddof=1) for own in scores]), rel=1e-12)
    ratio = f_oneway(*scores).statistic
    assert between**2 == pytest.approx((ratio - 1.0) * within**2 / 3.0, rel=1e-9)


def test_known_spreads_are_found_with_unequal_seeds() -> None:
    """10,000 methods of two to five seeds: 0.7 and 0.2, within 3 %."""
    rng = np.random.default_rng(1)
    scores = [rng.normal(rng.normal(25.0, 0.7), 0.2, rng.integers(2, 6)) for _ in range(10_000)]
    assert variance_components(scores) == pytest.approx((0.7, 0.2), rel=0.03)


def test_what_cannot_be_told_is_none() -> None:
    assert variance_components([np.array([1.0]), np.array([2.0])]) == (None, None)
    assert variance_components([np.array([1.0, 2.0])]) == (None, None)
    alike = [np.array([1.0, 3.0]), np.array([2.0, 2.0])]
    assert variance_components(alike) == (0.0, 1.0)


def test_agreement_and_saturation_by_hand() -> None:
    up, down = ([np.array([value, value]) for value in own] for own in ((1, 2, 4), (4, 2, 1)))
    scores = {"a": up, "b": up, "c": down}
    found = item_statistics(scores, dict.fromkeys(scores, 5.0), 0.0, higher=True)
    expected = np.corrcoef([1, 2, 4], [2.5, 2.0, 2.5])[0, 1]
    assert found[0].agreement == pytest.approx(expected)
    assert found[2].agreement == pytest.approx(np.corrcoef([4, 2, 1], [1, 2, 4])[0, 1])
    assert [(one.best, one.saturation) for one in found] == [(4.0, 0.8)] * 3
    assert (found[0].within, found[0].ratio, found[0].reliability) == (0.0, None, 1.0)


def test_the_table_puts_the_capture_first_that_tells_methods_apart() -> None:
    """Methods are 0.1 dB apart on capture 0 and 1 dB for each number more; seeds 0.1 dB."""
    results = [
        made_results(f"m{k}", lambda c, f, s, k=k: 20 + k * max(c, 0.1) + 0.1 * s, seed=seed)
        for k in range(3)
        for seed in range(3)
    ]
    table = discrimination_table(group_runs(results))
    psnr = [row for row in table.rows if row[0] == "PSNR"]
    assert [row[1] for row in psnr] == ["capture3", "capture2", "capture1", "capture0"]
    # Seeds at 0, 0.1 and 0.2 dB: 0.1; methods at 0, 3 and 6 dB: 3, less a third of the seeds'.
    assert psnr[0][3] == pytest.approx(0.1)
    assert psnr[0][2] == pytest.approx(np.sqrt(9.0 - 0.01 / 3.0))
    assert psnr[0][8] == pytest.approx(0.261)
    assert table.breaks == (4,)
    truth = made_results("truth", lambda c, f, s: 30.0)
    ceiling = discrimination_table(group_runs([*results, truth]), "truth")
    assert ceiling.rows[0][8] == pytest.approx(26.1 / 30.0)
    with pytest.raises(UsageError, match="no result is of"):
        discrimination_table(group_runs(results), "truth")
