"""How rates fall. Oracle: the formulas of the settings, written out at single steps."""

from __future__ import annotations

import math
from collections.abc import Callable

import pytest
import torch
from tiny_fits import UNJUDGED

from hwp_bench.methods.contract import TrainingCapture
from wildghand.fitting.components import make_fit
from wildghand.fitting.descent import rate_factor
from wildghand.model.settings import ScheduleSettings, read_settings


@pytest.mark.parametrize(
    ("fraction", "steps", "factor"),
    [
        (0.0, 0, 1.0),
        (0.5, 0, 0.1),
        (1.0, 0, 0.01),
        (0.0, 150, 0.5),
        (0.5, 150, 0.05),
    ],
)
def test_rates_fall_geometrically_and_with_the_root_of_the_steps(
    fraction: float, steps: int, factor: float
) -> None:
    schedule = ScheduleSettings(final_rate=0.01, root_steps=50.0)
    assert rate_factor(schedule, fraction, steps) == pytest.approx(factor, rel=1e-12)


def test_without_root_steps_only_the_share_of_the_budget_counts() -> None:
    schedule = ScheduleSettings(final_rate=0.01, root_steps=0.0)
    assert rate_factor(schedule, 0.5, 10_000) == pytest.approx(0.1, rel=1e-12)


def test_halving_halves_at_even_shares() -> None:
    schedule = ScheduleSettings(decay="halving", halvings=10, root_steps=0.0)
    found = [rate_factor(schedule, share, 7) for share in (0.0, 0.05, 0.1, 0.99)]
    assert found == [1.0, 1.0, 0.5, 0.5**9]


def test_every_group_falls_from_its_own_rate(make_training: Callable[..., TrainingCapture]) -> None:
    settings = read_settings({**UNJUDGED, "schedule.final_rate": 0.25, "schedule.root_steps": 100})
    descent = make_fit(make_training(), settings, 0, torch.device("cpu")).descent
    descent.steps = 300
    for _ in range(2):  # what was set before does not count
        descent.set_rates(0.5)
    factor = 0.5 / math.sqrt(4.0)
    found = {group["start"]: group["lr"] for group in descent.optimizer.param_groups}
    assert len(found) > 4
    assert list(found.values()) == pytest.approx([rate * factor for rate in found], rel=1e-12)
