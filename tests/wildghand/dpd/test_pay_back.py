"""Pay back. Oracles: the formula by hand, the frames themselves."""

from __future__ import annotations

import math

import pytest
import torch

from wildghand.dpd.temporal import PayBack

CLEAN = torch.tensor([1.0, 0.9, 0.8, 0.1, 0.0])


def watched(errors: list[float], tolerance: float = 2.0) -> PayBack:
    made = PayBack(CLEAN, tolerance)
    for row, error in enumerate(errors):
        if error:
            made.watch(torch.tensor([row]), torch.full((1, 4, 4), error), torch.ones(1, 4, 4))
    return made


def test_shares_are_the_formula() -> None:
    made = watched([0.01, 0.02, 0.03, 0.02, 0.08])
    # The clean frames' median is 0.02.
    shares = made.shares(torch.tensor([3, 4]))
    expected = [math.exp(-((0.02 / 0.04) ** 2)), math.exp(-((0.08 / 0.04) ** 2))]
    torch.testing.assert_close(shares, torch.tensor(expected))


def test_a_frame_that_was_not_drawn_is_not_explained() -> None:
    assert (watched([0.0] * 5).shares(torch.arange(5)) == 0.0).all()
    assert float(watched([0.01, 0.02, 0.03, 0.0, 0.0]).shares(torch.tensor([4]))) == 0.0
    # Nor is any while no clean frame was.
    assert float(watched([0.0, 0.0, 0.0, 0.02, 0.0]).shares(torch.tensor([3]))) == 0.0


def test_residuals_run_and_count_by_the_weights() -> None:
    made = PayBack(CLEAN, 1.0)
    weights = torch.tensor([[[1.0, 0.0]]])
    made.watch(torch.tensor([2]), torch.tensor([[[0.1, 9.0]]]), weights)
    assert float(made.residuals[2]) == pytest.approx(0.1 / 1.0)
    made.watch(torch.tensor([2]), torch.tensor([[[0.2, float("nan")]]]), weights)
    assert float(made.residuals[2]) == pytest.approx(0.15)
    made.watch(torch.tensor([2]), torch.ones(1, 1, 2), torch.zeros(1, 1, 2))
    assert made.residuals.isfinite().all()
