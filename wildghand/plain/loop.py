"""The loop of every fit: steps within a budget, checkpoints, and what is kept of a failed one.

The plain fit, the fit of WildGHand and pretraining are each an `IterativeFit`; `run_fit` is the
only place that takes their steps.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable, Iterator
from typing import Any, Generic, TypeVar

import torch

from hwp_bench.base.console import notice
from hwp_bench.methods.contract import Avatar, Budget, Report
from wildghand.gaussians.fit_loop import Guard, Loss, StepThreads, read_losses, repeatable, spent

#: Fall of the mean loss from window to window, as a share, that still counts as progress.
PROGRESS = 1e-3

Result = TypeVar("Result")


class IterativeFit(Generic[Result]):
    """A fit as the loop sees it. What it leaves at its default costs nothing.

    Attributes:
        device: where its tensors live.
        plateau_steps: window of the plateau, at which it stops early; 0: it never does.
        shared_steps: steps that share work which one of them does.
    """

    device: torch.device
    plateau_steps: int = 0
    shared_steps: int = 1

    def count_steps(self, budget: Budget) -> int:
        """The steps of the fit, where seconds do not end it before."""
        raise NotImplementedError

    def batches(self) -> Iterator[Any]:
        """The batches of the steps, without end and in the same order every time."""
        raise NotImplementedError

    def step(self, batch: Any, fraction: float) -> Loss:
        """Take one step; returns its loss, and changes nothing where that is not finite.

        Args:
            batch: of `batches`.
            fraction: share of the budget that is used up, in [0, 1).
        """
        raise NotImplementedError

    def finite(self) -> bool:
        """Whether every fitted number is finite."""
        raise NotImplementedError

    def snapshot(self) -> dict[str, torch.Tensor]:
        """Copies of everything fitted, which the fit no longer changes."""
        raise NotImplementedError

    def restore(self, values: dict[str, torch.Tensor]) -> None:
        """Go back to a `snapshot`."""
        raise NotImplementedError

    def checkpoint(self, steps: int) -> Avatar:
        """The avatar as it would be if the fit ended here; it may share live tensors."""
        raise NotImplementedError

    def finish(self, steps: int, seconds: float) -> Result:
        """End the fit; returns what it was for.

        Args:
            steps: behind the state that is kept.
            seconds: of fitting.
        """
        raise NotImplementedError

    def seconds_for_steps(self, seconds: float) -> float:
        """The part of a budget that is for steps; asked once, before the first one."""
        return seconds

    def seconds_now(self) -> float:
        """More seconds that are kept back by now; asked before each step."""
        return 0.0

    def agree(self, fraction: float) -> float:
        """The share of the budget that all processes of the fit go by."""
        return fraction

    def after_step(self) -> None:
        """Called after a step that was sound."""

    def state_dict(self) -> dict[str, Any]:
        """Everything that steps change, where the fit can be stopped and go on."""
        raise NotImplementedError

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Go on from a saved state."""
        raise NotImplementedError

    def tell(self, text: str) -> None:
        """Say something to the person who waits."""
        notice(text)


class Watchers:
    """Guard and plateau: the watchers of the loss of a fit.

    Args:
        plateau_steps: window of the plateau; 0 never stops early.
    """

    def __init__(self, plateau_steps: int) -> None:
        self.guard = Guard()
        self.plateau = Plateau(plateau_steps)

    def state_dict(self) -> dict[str, Any]:
        """The state for `load_state_dict`."""
        return {"guard": self.guard.state_dict(), "plateau": self.plateau.state_dict()}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Go on from a saved state."""
        self.guard.load_state_dict(state["guard"])
        self.plateau.load_state_dict(state["plateau"])


def run_fit(
    fit: IterativeFit[Result],
    budget: Budget,
    report: Report,
    *,
    start: int = 0,
    watchers: Watchers | None = None,
    after_step: Callable[[int, Watchers, Loss], None] | None = None,
    threads: StepThreads | None = None,
) -> Result:
    """Take steps until the budget is spent, the loss stands still, or the fit diverges.

    Args:
        threads: chooses how many threads steps run on; None: by what they gain.
    """
    steps, batches = fit.count_steps(budget), fit.batches()
    for _ in range(start):
        next(batches)
    watchers = watchers or Watchers(fit.plateau_steps)
    threads = threads or StepThreads.of(fit.device, fit.shared_steps)
    step = start
    report(step, fit.checkpoint(step))
    if budget.seconds is not None:
        budget = dataclasses.replace(budget, seconds=fit.seconds_for_steps(budget.seconds))
    with repeatable(fit.device):
        while step < steps:
            fraction = fit.agree(spent(step, steps, _without_kept(budget, fit), report))
            if fraction >= 1.0:
                break
            with threads.step():
                loss = fit.step(next(batches), fraction)
            if not watchers.guard.watch(step + 1, loss, fit):
                step = _go_back(fit, watchers, step)
                break
            step += 1
            report.progress(step, steps)
            fit.after_step()
            report(step, fit.checkpoint(step))
            if after_step is not None:
                after_step(step, watchers, loss)
            if watchers.plateau.reached(loss):
                fit.tell(f"The loss has stood still for {fit.plateau_steps} steps; finished early.")
                break
        if not watchers.guard.sound():
            step = _go_back(fit, watchers, step)
    return fit.finish(step, report.elapsed)


def _without_kept(budget: Budget, fit: IterativeFit[Any]) -> Budget:
    if budget.seconds is None:
        return budget
    return dataclasses.replace(budget, seconds=budget.seconds - fit.seconds_now())


def _go_back(fit: IterativeFit[Any], watchers: Watchers, step: int) -> int:
    """Bring a fit that diverged back to its best state; returns the steps behind that."""
    fit.restore(watchers.guard.best())
    kept = watchers.guard.step
    fit.tell(f"The fit diverged at step {step}; the state of step {kept} is kept.")
    return kept


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
