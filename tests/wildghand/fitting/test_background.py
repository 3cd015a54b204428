"""What is drawn off the hand. Oracles: squares, finite differences, a fit without the term."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
import torch
from tiny_fits import UNJUDGED

from hwp_bench.methods.contract import TrainingCapture
from wildghand.fitting.components import make_fit
from wildghand.fitting.fit import StepBatch
from wildghand.fitting.judging import MARGIN, Background, clear_background
from wildghand.model.settings import read_settings
from wildghand.model.terms import coverage_within

CPU = torch.device("cpu")


@pytest.mark.parametrize("size", [60, 240])
def test_only_what_is_off_mask_and_posed_hand_is_clear(size: int) -> None:
    place = np.zeros((size, size), dtype=np.uint16)
    place[10:20, 10:20] = 7
    mask = np.zeros((size, size), dtype=np.uint8)
    mask[30:40, 15:40] = 1  # a rim is hand, too
    margin = max(1, round(MARGIN * size))
    expected = np.ones((size, size), dtype=bool)
    expected[10 - margin : 20 + margin, 10 - margin : 20 + margin] = False
    expected[30 - margin : 40 + margin, 15 - margin : 40 + margin] = False
    np.testing.assert_array_equal(clear_background([place], mask[None])[0], expected)


def test_the_slope_of_the_term_is_that_of_finite_differences() -> None:
    random = torch.Generator().manual_seed(0)
    coverage = torch.rand(2, 5, 7, 1, generator=random, dtype=torch.float64, requires_grad=True)
    area = torch.rand(2, 5, 7, generator=random) > 0.5
    assert torch.autograd.gradcheck(lambda drawn: coverage_within(drawn, area), (coverage,))
    assert float(coverage_within(torch.ones(2, 5, 7, 1), area)) == pytest.approx(
        float(area.float().mean())
    )


def test_a_fit_draws_less_off_the_hand(make_training: Callable[..., TrainingCapture]) -> None:
    """At most 0.7 of what the same steps draw there without the term; the hand stays as closed."""
    training, off, inside = make_training(), [], []
    for weight in (0.0, 0.3):
        changes = {**UNJUDGED, "dpd.enabled": False, "terms.background": weight}
        fit = make_fit(training, read_settings(changes), 0, CPU)
        assert (fit.part(Background) is None) == (weight == 0.0)
        steps = fit.batches()
        for step in range(60):
            fit.step(next(steps), step / 60)
        rows = torch.arange(len(fit.data.frames))
        clear = torch.from_numpy(clear_background(fit.data.places, fit.data.frames.masks.numpy()))
        with torch.no_grad():
            coverage = fit.draw(StepBatch(rows)).coverage[..., 0]
        off.append(float(coverage[clear].sum()))
        inside.append(float(coverage[fit.data.frames.masks > 250].mean()))
    assert off[1] < 0.7 * off[0]
    assert inside[1] > inside[0] - 0.01
