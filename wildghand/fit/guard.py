"""Notice that a fit diverges, and keep the best state."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Generic, Protocol, TypeVar

import torch

from hwp_bench.errors import DidNotConverge

#: Steps over which the loss is averaged before it is judged.
WINDOW = 50
#: A mean loss of a window beyond this multiple of the best one means divergence.
MAX_RISE = 3.0


class Fitted(Protocol):
    """A model that is being fitted."""

    def parameters(self) -> Mapping[str, torch.Tensor]:
        """The fitted tensors by name."""
        ...

    def snapshot(self: Model) -> Model:
        """A copy that the fit no longer changes."""
        ...


Model = TypeVar("Model", bound=Fitted)


class Guard(Generic[Model]):
    """Watches the loss of a fit.

    Attributes:
        step: steps behind the state that is kept; 0 while there is none.
    """

    def __init__(self) -> None:
        self.step = 0
        self._best_loss = math.inf
        self._best: Model | None = None
        self._losses: list[float] = []

    def watch(self, step: int, loss: float, model: Model) -> bool:
        """Take note of the loss of `model` after `step` steps; False means divergence."""
        if not math.isfinite(loss):
            return False
        self._losses.append(loss)
        if len(self._losses) < WINDOW:
            return True
        mean = sum(self._losses) / len(self._losses)
        self._losses.clear()
        if not all(bool(value.isfinite().all()) for value in model.parameters().values()):
            return False
        if mean < self._best_loss:
            self._best_loss, self._best, self.step = mean, model.snapshot(), step
        return mean <= MAX_RISE * self._best_loss

    def best(self) -> Model:
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
