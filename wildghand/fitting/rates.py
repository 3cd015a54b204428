"""The optimizer of a fit, and how its rates fall."""

from __future__ import annotations

import math

from wildghand.gaussians.adam import ClippedAdam
from wildghand.model.model import WildGHandModel
from wildghand.model.settings import ScheduleSettings, WildGHandSettings
from wildghand.network import parameter_groups
from wildghand.pao.pao import PerturbationAwareWeights


def make_optimizer(
    model: WildGHandModel, weights: PerturbationAwareWeights, settings: WildGHandSettings
) -> ClippedAdam:
    """Adam over everything that is fitted; each group keeps its first rate as `start`."""
    rates = settings.schedule.rates
    groups = {name: list(group) for name, group in parameter_groups(model.network).items()}
    groups["dpd"] = list(model.perturbation.parameters())
    groups["thresholds"] = list(weights.parameters())
    groups["gains"] = [model.log_gains]
    groups["pose"] = [model.pose_steps]
    groups["transl"] = [model.transl_steps]
    return ClippedAdam(
        [
            {
                "params": group,
                "lr": getattr(rates, name),
                "start": getattr(rates, name),
                "clipped": name != "thresholds",
            }
            for name, group in groups.items()
            if group
        ],
        settings.schedule.clip_gradient,
    )


def rate_factor(schedule: ScheduleSettings, fraction: float, steps: int) -> float:
    """Factor on the first rates in a step.

    Args:
        schedule: how rates fall.
        fraction: share of the budget that is used up.
        steps: those behind.
    """
    if schedule.decay == "halving":
        factor = 0.5 ** int(fraction * schedule.halvings)
    else:
        factor = schedule.final_rate**fraction
    if schedule.root_steps:
        factor /= math.sqrt(1.0 + steps / schedule.root_steps)
    return factor


def set_rates(
    optimizer: ClippedAdam, schedule: ScheduleSettings, fraction: float, steps: int
) -> None:
    """Set the rates of all groups for a step; see `rate_factor`."""
    factor = rate_factor(schedule, fraction, steps)
    for group in optimizer.param_groups:
        group["lr"] = group["start"] * factor
