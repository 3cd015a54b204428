"""Robust weights. Oracles: loops over pixels in numpy; the formula; a drawn occluder."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from hwp_bench.base.errors import ShapeMismatch, UsageError
from wildghand.pao.regions import partition, stack_regions
from wildghand.pao.robust import RobustSettings, blended_residual, residual_weights, running_median

SIZE = 9


def scene(seed: int = 0) -> tuple[torch.Tensor, np.ndarray, torch.Tensor]:
    random = np.random.default_rng(seed)
    error = torch.from_numpy(random.uniform(0.0, 0.2, (2, SIZE, SIZE)))
    labels = random.integers(0, 5, (2, SIZE, SIZE))
    hand = torch.from_numpy(random.uniform(size=(2, SIZE, SIZE)) < 0.6)
    return error, labels, hand


def test_residuals_are_the_two_means_over_hand_pixels() -> None:
    error, labels, hand = scene()
    regions = stack_regions([partition(frame) for frame in labels])
    made = blended_residual(error, regions, hand, RobustSettings(region_share=0.3))
    for b, y, x in np.ndindex(2, SIZE, SIZE):
        if not hand[b, y, x]:
            assert made[b, y, x] == 0.0
            continue
        alike = (labels[b] == labels[b, y, x]) & hand[b].numpy()
        near = np.zeros((SIZE, SIZE), bool)
        near[max(y - 1, 0) : y + 2, max(x - 1, 0) : x + 2] = True
        near &= hand[b].numpy()
        values = error[b].numpy()
        expected = 0.3 * values[alike].mean() + 0.7 * values[near].mean()
        assert float(made[b, y, x]) == pytest.approx(expected, rel=1e-12)


def test_weights_are_the_formula() -> None:
    residual = torch.tensor([0.0, 0.01, 0.025, 0.1, float("inf"), float("nan")])
    weights = residual_weights(residual, 0.01)
    expected = [1.0, 1.0 / (1.0 + 0.4**4), 0.5, 1.0 / (1.0 + 4.0**4), 0.0, 0.0]
    np.testing.assert_allclose(weights, expected, rtol=1e-6)


def test_the_median_runs_and_starts_at_the_first() -> None:
    hand = torch.ones(1, 3, 3, dtype=torch.bool)
    first = running_median(None, torch.full((1, 3, 3), 0.1), hand)
    assert first == pytest.approx(0.1)
    second = running_median(first, torch.full((1, 3, 3), 0.2), hand, RobustSettings(rate=0.25))
    assert second == pytest.approx(0.125)
    assert running_median(0.3, torch.ones(1, 3, 3), ~hand) == 0.3
    assert running_median(None, torch.ones(1, 3, 3), ~hand) == RobustSettings().least_scale
    assert running_median(None, torch.full((1, 3, 3), float("inf")), hand) == 0.002
    assert running_median(None, torch.zeros(1, 3, 3), hand) == 0.002


def test_what_covers_the_hand_counts_little_and_the_hand_nearly_whole() -> None:
    random = np.random.default_rng(1)
    rows, columns = np.mgrid[:64, :64]
    hand = torch.ones(1, 64, 64, dtype=torch.bool)
    covered = (rows > 20) & (rows < 40) & (columns > 12)
    error = np.where(covered, random.uniform(0.1, 0.5, covered.shape), 0.0)
    error = torch.from_numpy(error + np.abs(random.normal(0.0, 0.02, covered.shape)))[None]
    regions = stack_regions([partition(rows // 8 * 8 + columns // 8)])
    residual = blended_residual(error, regions, hand)
    weights = residual_weights(residual, running_median(None, residual, hand))[0].numpy()
    assert weights[covered].mean() < 0.05
    assert weights[~covered].mean() > 0.75
    assert weights[~(covered | np.roll(covered, 9, 0) | np.roll(covered, -9, 0))].mean() > 0.8


@settings(max_examples=40, deadline=None)
@given(
    value=st.sampled_from([0.0, 0.5, 1.0, float("nan"), float("inf")]),
    hand=st.sampled_from([0.0, 0.5, 1.0]),
    share=st.floats(0.0, 1.0),
)
def test_weights_are_always_in_range(value: float, hand: float, share: float) -> None:
    error = torch.full((1, SIZE, SIZE), value)
    regions = stack_regions([partition(np.zeros((SIZE, SIZE), int))])
    mask = torch.full((1, SIZE, SIZE), hand)
    chosen = RobustSettings(region_share=share)
    residual = blended_residual(error, regions, mask, chosen)
    weights = residual_weights(residual, running_median(None, residual, mask, chosen), chosen)
    assert ((weights >= 0.0) & (weights <= 1.0)).all()
    assert not residual.isnan().any()


def test_one_bad_pixel_spoils_only_itself_and_no_gradient_passes() -> None:
    error, labels, hand = scene()
    hand[0, 4, 4] = True
    error[0, 4, 4] = float("nan")
    error.requires_grad_(True)
    regions = stack_regions([partition(frame) for frame in labels])
    residual = blended_residual(error, regions, hand)
    assert not residual.requires_grad
    assert torch.isinf(residual).sum() == 1
    assert residual_weights(residual, 0.1)[0, 4, 4] == 0.0


def test_bad_arguments_are_named() -> None:
    error, labels, hand = scene()
    regions = stack_regions([partition(frame) for frame in labels])
    with pytest.raises(ShapeMismatch, match="hand"):
        blended_residual(error, regions, hand[:1])
    for bad in ({"rate": 2.0}, {"cutoff": 0.0}, {"power": float("nan")}, {"region_share": -1.0}):
        with pytest.raises(UsageError, match=next(iter(bad))):
            RobustSettings(**bad)
