"""Notice that a fit makes no more progress."""

from __future__ import annotations

import math
from typing import Any

#: Fall of the mean loss from window to window, as a share, that still counts as progress.
PROGRESS = 1e-3


class Plateau:
    """Notices that the mean loss of a window is hardly lower than that of the one before.

    Args:
        window: steps of a window; 0 never notices.
    """

    def __init__(self, window: int) -> None:
        self._window = window
        self._losses: list[float] = []
        self._before = math.inf

    def reached(self, loss: float) -> bool:
        """Take note of a loss; True when the fit may stop."""
        if not self._window:
            return False
        self._losses.append(loss)
        if len(self._losses) < self._window:
            return False
        mean = sum(self._losses) / self._window
        self._losses.clear()
        before, self._before = self._before, mean
        return mean > (1.0 - PROGRESS) * before

    def state_dict(self) -> dict[str, Any]:
        """What `load_state_dict` takes."""
        return {"losses": list(self._losses), "before": self._before}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Go on from a saved state."""
        self._losses = [float(loss) for loss in state["losses"]]
        self._before = float(state["before"])
