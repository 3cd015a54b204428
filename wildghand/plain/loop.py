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
from hwp_bench.base.errors import DidNotConverge
from hwp_bench.methods.contract import Avatar, Budget, Report
from wildghand.gaussians.fit_loop import Loss, StepThreads, repeatable, spent

#: Steps over which the loss is averaged before it is judged.
WINDOW = 50
#: Steps after the last window whose mean loss is judged at the end of a fit.
FEWEST = 10
#: A mean loss of a window beyond this multiple of the best one means divergence.
MAX_RISE = 3.0

Result = TypeVar("Result")


class IterativeFit(Generic[Result]):
    """A fit as the loop sees it. Hooks at their defaults cost nothing.

    Attributes:
        device: where its tensors live.
    """

    device: torch.device

    @property
    def shared_steps(self) -> int:
        """Steps that share work which one of them does."""
        return 1

    def count_steps(self, budget: Budget) -> int:
        """The steps of the fit, where seconds do not end it before."""
        raise NotImplementedError

    def batches(self) -> Iterator[Any]:
        """The batches of the steps, without end and in the same order every time."""
        raise NotImplementedError

    def step(self, batch: Any, fraction: float) -> Loss:
        """Take one step; returns its loss, and changes nothing where that is not finite.

        Losses are not negative: divergence is told by how many times a loss has grown.

        Args:
            batch: of `batches`.
            fraction: share of the budget that is used up, in [0, 1).
        """
        raise NotImplementedError

    def finite(self) -> bool:
        """Whether every fitted number is finite."""
        raise NotImplementedError

    def skipped(self) -> int:
        """Steps so far that moved nothing, because a gradient was not finite.

        A few may happen; a window of nothing else means divergence.
        """
        return 0

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
        """Seconds of the budget that are reserved so far; asked before each step."""
        return 0.0

    def agree(self, fraction: float) -> float:
        """The share of the budget that all processes of the fit go by."""
        return fraction

    def after_step(self) -> None:
        """Called after a step that was sound."""

    def state_dict(self) -> dict[str, Any]:
        """Everything that steps change, where the fit can be stopped and continue."""
        raise NotImplementedError

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Continue from a saved state."""
        raise NotImplementedError

    def tell(self, text: str) -> None:
        """Say something to the person who waits."""
        notice(text)


class Watchers:
    """Watches the loss of a fit: whether it diverges.

    A loss that is on a device is looked at when its window ends. The steps until then are not kept
    if it turns out not to be finite.

    Attributes:
        step: steps behind the state that is kept; 0 while there is none.
    """

    def __init__(self) -> None:
        self.step = 0
        self._best: Any = None
        self._best_loss = math.inf
        self._skipped = 0
        self._losses: list[Loss] = []

    def watch(self, step: int, loss: Loss, model: Any) -> bool:
        """Take note of the loss after `step` steps; False means divergence.

        The `model` says whether it is `finite` and how many steps it has `skipped`, and gives a
        `snapshot` of its state.
        """
        if not isinstance(loss, torch.Tensor) and not math.isfinite(loss):
            return False
        self._losses.append(loss)
        if len(self._losses) < WINDOW:
            return True
        mean = sum(_read_losses(self._losses)) / WINDOW
        self._losses.clear()
        before, self._skipped = self._skipped, model.skipped()
        if not math.isfinite(mean) or self._skipped - before == WINDOW or not model.finite():
            return False
        if mean < self._best_loss:
            self._best_loss, self._best, self.step = mean, model.snapshot(), step
        return mean <= MAX_RISE * self._best_loss

    def sound(self, model: Any) -> bool:
        """Whether a fit ends well: since the last window all is finite, and no loss has risen far.

        A few losses without a skipped step may be those of hard frames, and are not judged.
        """
        losses = _read_losses(self._losses)
        if not (all(map(math.isfinite, losses)) and model.finite()):
            return False
        skipped = model.skipped() - self._skipped
        if self._best is None:
            return not 0 < len(losses) == skipped
        judged = skipped > 0 or len(losses) >= FEWEST
        return not judged or sum(losses) <= MAX_RISE * self._best_loss * len(losses)

    def best(self) -> Any:
        """The state with the lowest loss; `DidNotConverge` if there was none."""
        if self._best is None:
            raise DidNotConverge(
                f"the fit diverged within its first {WINDOW} steps",
                remedy="Lower the learning rates, or check the capture's hand parameters.",
            )
        return self._best

    def state_dict(self) -> dict[str, Any]:
        """The state for `load_state_dict`."""
        return {
            "step": self.step,
            "best": self._best,
            "best_loss": self._best_loss,
            "skipped": self._skipped,
            "losses": _read_losses(self._losses),
        }

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Continue from a saved state."""
        self.step, self._best = int(state["step"]), state["best"]
        self._best_loss = float(state["best_loss"])
        self._skipped = int(state["skipped"])
        self._losses = [float(loss) for loss in state["losses"]]


def _read_losses(losses: list[Loss]) -> list[float]:
    """The losses of some steps as numbers; waits once for those that are on a device."""
    held = [loss for loss in losses if isinstance(loss, torch.Tensor)]
    numbers = iter(torch.stack(held).tolist() if held else ())
    return [next(numbers) if isinstance(loss, torch.Tensor) else loss for loss in losses]


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
    """Take steps until the budget is spent or the fit diverges.

    Args:
        threads: chooses how many threads steps run on; None: by what they gain.
    """
    steps, batches = fit.count_steps(budget), fit.batches()
    for _ in range(start):
        next(batches)
    watchers = watchers or Watchers()
    threads = threads or StepThreads.of(fit.device, fit.shared_steps)
    step, diverged = start, False
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
            diverged = not watchers.watch(step + 1, loss, fit)
            if diverged:
                break
            step += 1
            report.progress(step, steps)
            fit.after_step()
            report(step, fit.checkpoint(step))
            if after_step is not None:
                after_step(step, watchers, loss)
        if diverged or not watchers.sound(fit):
            step = _go_back(fit, watchers, step)
        elif skipped := fit.skipped():
            fit.tell(f"{skipped} of {step} steps were skipped: a gradient was not finite.")
    return fit.finish(step, report.elapsed)


def _without_kept(budget: Budget, fit: IterativeFit[Any]) -> Budget:
    if budget.seconds is None:
        return budget
    return dataclasses.replace(budget, seconds=budget.seconds - fit.seconds_now())


def _go_back(fit: IterativeFit[Any], watchers: Watchers, step: int) -> int:
    """Bring a fit that diverged back to its best state; returns the steps behind that."""
    fit.restore(watchers.best())
    kept = watchers.step
    fit.tell(f"The fit diverged at step {step}; the state of step {kept} is kept.")
    return kept
