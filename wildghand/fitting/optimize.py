"""The loop of a fit: steps within a budget, checkpoints, and what is kept of a failed one."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable
from typing import Any

import torch

from hwp_bench.base.console import notice
from hwp_bench.methods.contract import Budget, Report
from wildghand.avatar.avatar import WildGHandAvatar
from wildghand.fitting.averaging import AveragedAvatar
from wildghand.fitting.fit import Fit
from wildghand.fitting.parallel import World
from wildghand.gaussians.fit_loop import (
    Guard,
    Loss,
    StepThreads,
    batches,
    read_losses,
    repeatable,
    spent,
)

#: Fall of the mean loss from window to window, as a share, that still counts as progress.
PROGRESS = 1e-3

#: Looks at a fit: (fit, steps so far, loss of the last one). It changes nothing of the fit.
Watch = Callable[[Fit, int, Loss], None]


class Watchers:
    """Guard and plateau: the watchers of the loss of a fit.

    Args:
        plateau_steps: window of the plateau; 0 never stops early.
    """

    def __init__(self, plateau_steps: int) -> None:
        self.guard: Guard[dict[str, torch.Tensor]] = Guard()
        self.plateau = Plateau(plateau_steps)

    def state_dict(self) -> dict[str, Any]:
        """The state for `load_state_dict`."""
        return {"guard": self.guard.state_dict(), "plateau": self.plateau.state_dict()}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Go on from a saved state."""
        self.guard.load_state_dict(state["guard"])
        self.plateau.load_state_dict(state["plateau"])


def optimize(
    fit: Fit,
    budget: Budget,
    report: Report,
    *,
    start: int = 0,
    watchers: Watchers | None = None,
    after_step: Callable[[int, Watchers], None] | None = None,
    watch: Watch | None = None,
    threads: StepThreads | None = None,
) -> WildGHandAvatar:
    """Take steps until the budget is spent, the loss stands still, or the fit diverges.

    Args:
        fit: what is fitted.
        budget: when to stop; without steps the settings' number holds.
        report: where checkpoints are offered.
        start: steps that `fit` has behind it.
        watchers: those of the fit so far, where it goes on.
        after_step: called with the number of steps after each; saves, for instance.
        watch: looks at the fit after each step, and changes nothing of it.
        threads: chooses how many threads steps run on; None: by what they gain.

    Returns:
        The mean of the last states, or of earlier ones where validation frames chose them; the best
        one if the fit diverged later. Of several processes,
        rank 0's has the record of the weights.

    Raises:
        DidNotConverge: the fit diverged without ever having been better than its start.
    """
    settings, world = fit.settings, fit.world
    steps = settings.schedule.steps if budget.steps is None else budget.steps
    order = batches(len(fit.frames), settings.schedule.batch, fit.seed)
    for _ in range(start):
        next(order)
    watchers = watchers or Watchers(settings.schedule.plateau_steps)
    threads = threads or StepThreads.of(fit.device, settings.schedule.texture_every)
    step = start
    report(step, AveragedAvatar(fit.avatar(step), fit.average))
    if budget.seconds is not None:
        budget = dataclasses.replace(budget, seconds=fit.seconds_for_steps(budget.seconds))
    with repeatable(fit.device):
        while step < steps:
            # All processes go by the clock of rank 0, or some would stop a step before the others.
            fraction = world.broadcast(spent(step, steps, _for_steps(budget, fit), report))
            if fraction >= 1.0:
                break
            with threads.step():
                loss = fit.step(next(order), fraction)
            if not watchers.guard.watch(step, loss, fit.model):
                step = _go_back(fit, watchers, step)
                break
            step += 1
            report.progress(step, steps)
            fit.average.take()
            fit.state_choice.states.take()
            report(step, AveragedAvatar(fit.avatar(step), fit.average))
            if after_step is not None:
                after_step(step, watchers)
            if watch is not None:
                watch(fit, step, loss)
            if watchers.plateau.reached(loss):
                window = settings.schedule.plateau_steps
                _tell(world, f"The loss has stood still for {window} steps; finished early.")
                break
        if not watchers.guard.sound():
            step = _go_back(fit, watchers, step)
    fit.average.put()
    chosen = fit.finish()
    if chosen is not None:
        _tell(world, f"The state of step {chosen} draws the validation frames best; it is kept.")
    return fit.avatar(step, report.elapsed, chosen=chosen, final=world.is_main)


def _for_steps(budget: Budget, fit: Fit) -> Budget:
    """The budget without the seconds in which the states so far will be judged."""
    if budget.seconds is None:
        return budget
    return dataclasses.replace(budget, seconds=budget.seconds - fit.state_choice.seconds())


def _go_back(fit: Fit, watchers: Watchers, step: int) -> int:
    """Bring a fit that diverged back to its best state; returns the steps behind that."""
    fit.model.load_state_dict(watchers.guard.best())
    fit.average.forget()
    fit.state_choice.states.forget()
    kept = watchers.guard.step
    _tell(fit.world, f"The fit diverged at step {step}; the state of step {kept} is kept.")
    return kept


def _tell(world: World, text: str) -> None:
    if world.is_main:
        notice(text)


class Plateau:
    """Notices that the mean loss of a window is hardly lower than that of the window before.

    Args:
        window: steps of a window; 0 never notices.
    """

    def __init__(self, window: int) -> None:
        self._window = window
        self._losses: list[Loss] = []
        self._before = math.inf

    def reached(self, loss: Loss) -> bool:
        """Take note of a loss; True when the fit may stop."""
        if not self._window:
            return False
        self._losses.append(loss)
        if len(self._losses) < self._window:
            return False
        mean = sum(read_losses(self._losses)) / self._window
        self._losses.clear()
        before, self._before = self._before, mean
        return mean > (1.0 - PROGRESS) * before

    def state_dict(self) -> dict[str, Any]:
        """The state for `load_state_dict`."""
        return {"losses": read_losses(self._losses), "before": self._before}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Go on from a saved state."""
        self._losses = [float(loss) for loss in state["losses"]]
        self._before = float(state["before"])
