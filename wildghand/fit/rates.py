"""Adam with a step for each group of parameters, and how the steps fall."""

from __future__ import annotations

import torch

from wildghand.model.model import WildGHandModel
from wildghand.model.settings import WildGHandSettings
from wildghand.network import parameter_groups
from wildghand.pao.pao import PerturbationAwareWeights

# Gradients of a mean over all pixels are small beside Adam's usual 1e-8.
_EPSILON = 1e-15
_BETAS = (0.9, 0.99)


def make_optimizer(
    model: WildGHandModel, weights: PerturbationAwareWeights, settings: WildGHandSettings
) -> torch.optim.Adam:
    """Adam over everything that is fitted; each group keeps its first rate as `start`."""
    rates = settings.schedule.rates
    groups = {name: list(group) for name, group in parameter_groups(model.network).items()}
    groups["dpd"] = list(model.perturbation.parameters())
    groups["thresholds"] = list(weights.parameters())
    groups["gains"] = [model.log_gains]
    groups["pose"] = [model.pose_steps]
    groups["transl"] = [model.transl_steps]
    return torch.optim.Adam(
        [
            {"params": group, "lr": getattr(rates, name), "start": getattr(rates, name)}
            for name, group in groups.items()
            if group
        ],
        eps=_EPSILON,
        betas=_BETAS,
        fused=True,
    )


def set_rates(optimizer: torch.optim.Adam, settings: WildGHandSettings, fraction: float) -> None:
    """Set the steps for a share of the budget that is used up."""
    schedule = settings.schedule
    if schedule.decay == "halving":
        factor = 0.5 ** int(fraction * schedule.halvings)
    else:
        factor = schedule.final_rate**fraction
    for group in optimizer.param_groups:
        group["lr"] = group["start"] * factor
