"""Notice that a fit diverges, and keep the best state."""

from __future__ import annotations

import math
from typing import Any, Generic, Protocol, TypeVar

from hwp_bench.base.errors import DidNotConverge

#: Steps over which the loss is averaged before it is judged.
WINDOW = 50
#: A mean loss of a window beyond this multiple of the best one means divergence.
MAX_RISE = 3.0

Snapshot = TypeVar("Snapshot", covariant=True)
Kept = TypeVar("Kept")


class Fitted(Protocol[Snapshot]):
    """A model that is being fitted."""

    def finite(self) -> bool:
        """Whether every fitted number is finite."""
        ...

    def snapshot(self) -> Snapshot:
        """A copy of the state that the fit no longer changes."""
        ...


class Guard(Generic[Kept]):
    """Watches the loss of a fit.

    Attributes:
        step: steps behind the state that is kept; 0 while there is none.
    """

    def __init__(self) -> None:
        self.step = 0
        self._best_loss = math.inf
        self._best: Kept | None = None
        self._losses: list[float] = []

    def watch(self, step: int, loss: float, model: Fitted[Kept]) -> bool:
        """Take note of the loss of `model` after `step` steps; False means divergence."""
        if not math.isfinite(loss):
            return False
        self._losses.append(loss)
        if len(self._losses) < WINDOW:
            return True
        mean = sum(self._losses) / len(self._losses)
        self._losses.clear()
        if not model.finite():
            return False
        if mean < self._best_loss:
            self._best_loss, self._best, self.step = mean, model.snapshot(), step
        return mean <= MAX_RISE * self._best_loss

    def best(self) -> Kept:
        """The state with the lowest loss.

        Raises:
            DidNotConverge: the fit diverged before there was one.
        """
        if self._best is None:
            raise DidNotConverge(
                f"the fit diverged within its first {WINDOW} steps",
                remedy="Lower the learning rates, or check the capture's hand parameters.",
            )
        return self._best

    def state_dict(self) -> dict[str, Any]:
        """What `load_state_dict` takes."""
        return {
            "step": self.step,
            "best_loss": self._best_loss,
            "best": self._best,
            "losses": list(self._losses),
        }

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Go on from a saved state."""
        self.step = int(state["step"])
        self._best_loss = float(state["best_loss"])
        self._best = state["best"]
        self._losses = [float(loss) for loss in state["losses"]]
