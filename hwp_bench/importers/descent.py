"""One stage of the fit: Adam with a learning rate for each kind of variable."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import fields

import torch

from hwp_bench.base.errors import DidNotConverge
from hwp_bench.importers.clip_model import ClipModel, PosedClip

#: First step of each variable, in its own unit; constants move slower than poses.
LEARNING_RATES = {
    "turn": 0.02,
    "fingers": 0.03,
    "anchor": 0.03,
    "log_depth": 0.01,
    "betas": 0.02,
    "offsets": 0.0003,
    "log_size": 0.003,
    "log_focal": 0.003,
}
# The rate rises over the first steps and ends at this share.
_WARM_UP = 20
_LAST_RATE = 0.02


def descend(
    model: ClipModel,
    energy: Callable[[ClipModel, PosedClip], torch.Tensor],
    steps: int,
    *,
    rate: float = 1.0,
    hold: tuple[str, ...] = (),
    update: Callable[[int], None] | None = None,
) -> float:
    """Lower an energy over the model's variables, in place.

    Args:
        model: the clip.
        energy: maps the model and its posed clip to a scalar.
        steps: number of steps.
        rate: factor on all learning rates.
        hold: variables that stay.
        update: told the number of steps done.

    Returns:
        The last energy.

    Raises:
        DidNotConverge: the energy is not finite.
    """
    groups = [
        {"params": [getattr(model.variables, field.name)], "lr": rate * LEARNING_RATES[field.name]}
        for field in fields(model.variables)
        if field.name not in hold
    ]
    optimizer = torch.optim.Adam(groups, betas=(0.9, 0.99))

    def schedule(step: int) -> float:
        fall = 0.5 * (1.0 + math.cos(math.pi * step / steps))
        return min(1.0, (step + 1) / _WARM_UP) * (_LAST_RATE + (1.0 - _LAST_RATE) * fall)

    scheduler = torch.optim.lr_scheduler.LambdaLR(optimizer, schedule)
    with _one_thread():
        return _run(model, energy, steps, optimizer, scheduler, update)


@contextmanager
def _one_thread() -> Iterator[None]:
    """Hold torch to one thread: its operations here are too small to share out.

    On a busy machine the threads of a small operation wait for each other, and a fit takes
    several times as long.
    """
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(threads)


def _run(
    model: ClipModel,
    energy: Callable[[ClipModel, PosedClip], torch.Tensor],
    steps: int,
    optimizer: torch.optim.Optimizer,
    scheduler: torch.optim.lr_scheduler.LRScheduler,
    update: Callable[[int], None] | None,
) -> float:
    value = math.nan
    for step in range(steps):
        optimizer.zero_grad(set_to_none=True)
        loss = energy(model, model.posed())
        value = float(loss.detach())
        if not math.isfinite(value):
            raise DidNotConverge(
                f"the fit of the hand left the finite numbers in step {step}",
                remedy="Check the landmarks; a focal length far off can do this too (--focal).",
            )
        loss.backward()
        optimizer.step()
        scheduler.step()
        if update is not None:
            update(step + 1)
    return value
