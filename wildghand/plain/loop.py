"""The loop of every fit of the plain model: Adam over random batches of frames."""

from __future__ import annotations

from typing import Any

import torch

from hwp_bench.base.console import notice
from hwp_bench.methods.contract import Avatar, Budget, Report
from wildghand.gaussians.adam import ClippedAdam
from wildghand.gaussians.fit_loop import Guard, StepThreads, batches, repeatable, spent
from wildghand.plain.hooks import Batch, Recipe

# Adam's epsilon: gradients of a mean over all pixels are small.
_EPSILON = 1e-15
_BETAS = (0.9, 0.99)


def run_fit(recipe: Recipe[Any], budget: Budget, report: Report) -> Avatar:
    """Fit a recipe's tensors, within the budget.

    Args:
        recipe: what is fitted, and how; its tensors are changed.
        budget: when to stop; without steps the settings' number holds.
        report: where checkpoints are offered.

    Returns:
        The avatar of the last state; of the best one if the fit diverged later.

    Raises:
        DidNotConverge: the fit diverged without ever having been better than its start.
    """
    settings, frames, device = recipe.settings, recipe.material.frames, recipe.material.device
    steps = settings.steps if budget.steps is None else budget.steps
    parameters = recipe.parameters()
    optimizer = ClippedAdam(
        [{"params": [tensor.requires_grad_()], "lr": 0.0} for tensor in parameters.values()],
        betas=_BETAS,
        epsilon=_EPSILON,
    )
    order = batches(len(frames), settings.batch, recipe.material.seed)
    images, masks = frames.images_on(device), frames.masks_on(device)
    guard: Guard[dict[str, torch.Tensor]] = Guard()
    threads = StepThreads.of(device)
    step = 0
    report(step, recipe.avatar(step))
    with repeatable(device):
        while step < steps and (fraction := spent(step, steps, budget, report)) < 1.0:
            for group, name in zip(optimizer.param_groups, parameters, strict=True):
                group["lr"] = recipe.rate(name, fraction)
            with threads.step():
                rows = next(order)
                batch = Batch(step, fraction, rows, images(rows), masks(rows))
                drawing = recipe.draw(batch)
                loss = recipe.loss(batch, drawing, recipe.weights(batch, drawing))
                if not guard.watch(step, float(loss.detach()), recipe):
                    recipe.restore(guard.best())
                    notice(
                        f"The fit diverged at step {step}; the state of step {guard.step} is kept."
                    )
                    step = guard.step
                    break
                optimizer.clear()
                loss.backward()
                optimizer.take_step(loss)
                recipe.after_step(batch)
            step += 1
            report.progress(step, steps)
            report(step, recipe.avatar(step))
    for tensor in parameters.values():
        tensor.requires_grad_(False)
    return recipe.avatar(step)
