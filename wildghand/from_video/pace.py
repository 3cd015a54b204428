"""How long the stages of a job may still take."""

from __future__ import annotations

from collections.abc import Sequence


class Pace:
    """Scales expected seconds by those that the stages of this run took.

    Args:
        expected: seconds of each stage on some machine.
    """

    def __init__(self, expected: Sequence[float]) -> None:
        self._expected = list(expected)
        self._ran: dict[int, float] = {}

    def ran(self, stage: int, seconds: float) -> None:
        """Take note of the seconds that a stage took."""
        self._ran[stage] = seconds

    def left(self, stage: int) -> tuple[float, float]:
        """Return the seconds that a stage may take, and those of all after it."""
        planned = sum(self._expected[one] for one in self._ran)
        factor = sum(self._ran.values()) / planned if planned > 0.0 else 1.0
        return factor * self._expected[stage], factor * sum(self._expected[stage + 1 :])
