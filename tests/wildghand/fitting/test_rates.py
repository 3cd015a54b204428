"""How rates fall. Oracle: the formulas of the settings, written out at single steps."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import pytest
import torch
from tiny_fits import UNJUDGED

from hwp_bench.methods.contract import TrainingCapture
from wildghand.fitting.components import make_fit
from wildghand.fitting.descent import rate_factor
from wildghand.model.settings import ScheduleSettings, read_settings


@pytest.mark.parametrize(
    ("fraction", "steps", "factor"),
    [(0.0, 0, 1.0), (0.5, 0, 0.3**0.5), (1.0, 0, 0.3), (0.0, 600, 0.5), (1.0, 600, 0.15)],
)
def test_rates_fall_geometrically_and_with_the_root_of_the_steps(
    fraction: float, steps: int, factor: float
) -> None:
    found = rate_factor(ScheduleSettings(), fraction, steps, 1.0)
    assert found == pytest.approx(factor, rel=1e-12)


def test_without_the_root_only_the_share_of_the_budget_counts() -> None:
    schedule = ScheduleSettings(decay="geometric")
    assert rate_factor(schedule, 0.5, 10_000, 1.0) == pytest.approx(0.05**0.5, rel=1e-12)


@pytest.mark.parametrize("rates", ["paper", "released"])
def test_published_rates_are_halved_every_five_epochs_whatever_the_budget(rates: str) -> None:
    # 48 frames, 4 a step: 12 steps an epoch.
    schedule = ScheduleSettings(rates=rates)
    found = [rate_factor(schedule, 0.7, steps, 12.0) for steps in (0, 59, 60, 119, 120, 599)]
    assert found == [1.0, 1.0, 0.5, 0.5, 0.25, 0.5**9]


def test_every_group_falls_from_its_own_rate(make_training: Callable[..., TrainingCapture]) -> None:
    settings = read_settings(UNJUDGED)
    descent = make_fit(make_training(), settings, 0, torch.device("cpu")).descent
    descent.steps = 300
    for _ in range(2):  # what was set before does not count
        descent.set_rates(0.5)
    factor = math.sqrt(0.3) / math.sqrt(1.0 + 300 / 200)
    found = {group["start"]: group["lr"] for group in descent.optimizer.param_groups}
    assert len(found) > 4
    assert list(found.values()) == pytest.approx([rate * factor for rate in found], rel=1e-12)


@pytest.mark.parametrize(
    ("changes", "fitted"),
    [
        ({}, True),
        ({"dpd": {"enabled": False}}, False),
        ({"dpd": {"additions": False}}, False),
        ({"mode": "bare"}, False),
        ({"mode": "paper"}, False),
        ({"mode": "released"}, False),
    ],
)
def test_gains_of_frames_are_fitted_where_something_holds_them(
    changes: dict[str, Any], fitted: bool, make_training: Callable[..., TrainingCapture]
) -> None:
    """A gain that nothing holds trades places with the colour of the hand."""
    settings = read_settings({**UNJUDGED, **changes})
    fit = make_fit(make_training(), settings, 0, torch.device("cpu"))
    groups = fit.descent.optimizer.param_groups
    found = any(one is fit.model.log_gains for group in groups for one in group["params"])
    assert found == fit.model.log_gains.requires_grad == fitted
