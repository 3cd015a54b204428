"""States that a fit has passed through, of which validation frames choose where it ends.

A fit that goes on learns what is wrong in single frames: a pose that a tracker gave, a finger that
lies 3 px off its place. It draws its training frames the better for it, and others worse. How soon
that begins depends on how wrong the frames are, which nothing in them tells.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

from torch import Tensor

from wildghand.fitting.averaging import StepAverage

# How often a fit has seen each frame when the first state is kept.
_FIRST = 2.5


class EarlierStates:
    """Means of a fit's steps, kept after some of them and each time after twice as many.

    Args:
        average: the mean of the steps so far.
        first: steps until the first state is kept, at least 1; 0: none ever is.
    """

    def __init__(self, average: StepAverage, first: int) -> None:
        self._average = average
        self._first = first
        self._steps = 0
        self._kept: dict[int, list[Tensor]] = {}

    @classmethod
    def of_epochs(cls, average: StepAverage, frames: int, batch: int) -> EarlierStates:
        """Keep states by how often a fit has seen its frames.

        Args:
            average: the mean of the steps so far.
            frames: that are fitted, at least 1.
            batch: frames in each step.
        """
        return cls(average, max(1, round(_FIRST * frames / batch)))

    def take(self) -> None:
        """Take note of a step, after the average has."""
        self._steps += 1
        if self._steps == self._first * 2 ** len(self._kept):
            self._kept[self._steps] = self._average.values()

    @property
    def candidates(self) -> list[int]:
        """Steps behind the states that may be gone back to, the last one first.

        Those from more than half of the steps are too near to the end to differ from it.
        """
        return [step for step in sorted(self._kept, reverse=True) if 2 * step <= self._steps]

    def choose(self, error: Callable[[], float]) -> int | None:
        """Go back, from the state that is there, as long as that makes an error smaller.

        Args:
            error: of the state that is in place; asked for it first, then for one state after
                another, the last one first.

        Returns:
            Steps behind the state that is now in place; None: it is the one that was there.
        """
        candidates = self.candidates
        if not candidates:
            return None
        best, chosen, least = self._average.now(), None, error()
        for step in candidates:
            self._average.restore(self._kept[step])
            found = error()
            if not found < least:
                break
            best, chosen, least = self._kept[step], step, found
        self._average.restore(best)
        return chosen

    def forget(self) -> None:
        """Begin again, as before the first step."""
        self._steps, self._kept = 0, {}

    def state_dict(self) -> dict[str, Any]:
        """The state for `load_state_dict`."""
        return {"steps": self._steps, "kept": dict(self._kept)}

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Go on from a saved state."""
        self._steps = int(state["steps"])
        self._kept = {
            int(step): [value.clone() for value in values] for step, values in state["kept"].items()
        }
