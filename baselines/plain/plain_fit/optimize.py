"""The optimization of the plain avatar: Adam over random batches of frames."""

from __future__ import annotations

import math

import torch

from hwp_bench.base.progress import notice
from hwp_bench.methods.contract import Budget, Report, TrainingCapture
from plain_fit.model import PlainAvatar, PlainModel
from plain_fit.settings import PlainSettings
from wildghand.gaussians.fit_loop import Guard, batches, repeatable, spent
from wildghand.gaussians.frame_table import soft_weights
from wildghand.gaussians.losses import photometric_loss
from wildghand.gaussians.training import TrainingClip, TrainingFrames

# Standard deviations stay within these, m: thinner than paper or wider than a finger explains
# nothing of a hand.
_SCALES = (2e-5, 1e-2)
# Adam's epsilon: gradients of a mean over all pixels are small.
_EPSILON = 1e-15
_BETAS = (0.9, 0.99)


def fit_model(
    model: PlainModel,
    training: TrainingCapture,
    frames: TrainingFrames,
    settings: PlainSettings,
    budget: Budget,
    report: Report,
    seed: int,
) -> PlainAvatar:
    """Fit a model, within the budget.

    Args:
        model: where to start; its tensors are changed.
        training: hand parameters and cameras.
        frames: the frames to fit.
        settings: how.
        budget: when to stop.
        report: where checkpoints are offered.
        seed: of the order of the frames.

    Returns:
        The last state; the best one if the fit diverged later.

    Raises:
        DidNotConverge: the fit diverged without ever having been better than its start.
    """
    steps = settings.steps if budget.steps is None else budget.steps
    device = model.light.device
    clip = TrainingClip(training, frames.indices, model.rigs, device)
    parameters = model.parameters()
    rates = learning_rates(settings)
    optimizer = torch.optim.Adam(
        [{"params": [tensor.requires_grad_()], "lr": 0.0} for tensor in parameters.values()],
        eps=_EPSILON,
        betas=_BETAS,
        fused=True,
    )
    order = batches(len(frames), settings.batch, seed)
    images, masks = frames.images_on(device), frames.masks_on(device)
    guard: Guard[PlainModel] = Guard()
    step = 0
    report(step, PlainAvatar(model, step))
    with repeatable(device):
        while step < steps and (fraction := spent(step, steps, budget, report)) < 1.0:
            for group, name in zip(optimizer.param_groups, parameters, strict=True):
                group["lr"] = rates[name] * settings.final_rate**fraction
            rows = next(order)
            image, _ = model.render(
                clip.poses(rows),
                clip.viewmats[rows],
                clip.Ks[rows],
                training.width,
                training.height,
            )
            weights = soft_weights(masks(rows), settings.outside_weight)
            loss = photometric_loss(image, images(rows), weights, settings.dssim_weight)
            if not guard.watch(step, float(loss.detach()), model):
                model = guard.best()
                notice(f"The fit diverged at step {step}; the state of step {guard.step} is kept.")
                return PlainAvatar(model, guard.step)
            optimizer.zero_grad()
            loss.backward()
            optimizer.step()
            _clamp(model)
            step += 1
            report.progress(step, steps)
            report(step, PlainAvatar(model, step))
    return PlainAvatar(model.snapshot(), step)


def learning_rates(settings: PlainSettings) -> dict[str, float]:
    """Adam's step at the start by parameter name."""
    return {
        "offsets": settings.offset_rate,
        "log_scales": settings.scale_rate,
        "quats": settings.quat_rate,
        "logit_opacities": settings.opacity_rate,
        "logit_colors": settings.color_rate,
        "light": settings.light_rate,
    }


@torch.no_grad()
def _clamp(model: PlainModel) -> None:
    low, high = _SCALES
    model.gaussians.log_scales.clamp_(math.log(low), math.log(high))
