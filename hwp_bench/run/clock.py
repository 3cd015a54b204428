"""The method's clock and the checkpoints that are taken while it stands still."""

from __future__ import annotations

import resource
import sys
import time
from collections.abc import Callable
from pathlib import Path

from hwp_bench.base.files import write_json
from hwp_bench.methods.contract import Avatar, Budget
from hwp_bench.run.facts import Checkpoint

#: Seconds between two writes of the progress file.
PROGRESS_INTERVAL = 0.5


def schedule(budget: Budget) -> list[float]:
    """Return the seconds at which checkpoints are due: dense at the start, then regular.

    1, 2, 4, 8, ... s, and every tenth of the budget where one in seconds is set. (What a method
    offers first, and tenths of a budget in steps, are `ReportClock`'s business.)
    """
    horizon = budget.seconds or 24 * 3600.0
    due = {float(2**power) for power in range(18) if 2**power <= horizon}
    if budget.seconds:
        due |= {budget.seconds * tenth / 10 for tenth in range(1, 10)}
    return sorted(due)


class ReportClock:
    """The `Report` that a method is given.

    Args:
        budget: the budget of the fit.
        record: called with (index, avatar) when a checkpoint is taken; what it costs is not
            counted.
        progress_file: where the runner looks how far the fit is.
    """

    def __init__(
        self, budget: Budget, record: Callable[[int, Avatar], None], progress_file: Path
    ) -> None:
        self._due = schedule(budget)
        self._due_steps = [budget.steps * tenth / 10 for tenth in range(1, 10) if budget.steps]
        self._record = record
        self._progress_file = progress_file
        self._last_progress = 0.0
        self._paused = 0.0
        self._start = time.perf_counter()
        self.checkpoints: list[Checkpoint] = []

    @property
    def elapsed(self) -> float:
        """Seconds on the method's clock."""
        return time.perf_counter() - self._start - self._paused

    @property
    def paused(self) -> float:
        """Seconds that the clock has stood still for checkpoints."""
        return self._paused

    def __call__(self, step: int, avatar: Avatar) -> None:
        """Take a checkpoint if one is due; what is offered first always is one."""
        in_time = self._due and self.elapsed >= self._due[0]
        in_steps = self._due_steps and step >= self._due_steps[0]
        if in_time or in_steps or not self.checkpoints:
            self.take(step, avatar)

    def take(self, step: int, avatar: Avatar) -> None:
        """Take a checkpoint now; the clock stands still meanwhile."""
        seconds = self.elapsed
        entered = time.perf_counter()
        self._due = [moment for moment in self._due if moment > seconds]
        self._due_steps = [due for due in self._due_steps if due > step]
        self._record(len(self.checkpoints), avatar)
        self.checkpoints.append(Checkpoint(step, seconds, peak_memory()))
        self._paused += time.perf_counter() - entered

    def progress(self, done: int, total: int) -> None:
        """Tell the runner how far the fit is."""
        now = time.perf_counter()
        if now - self._last_progress >= PROGRESS_INTERVAL or done >= total:
            self._last_progress = now
            write_json(self._progress_file, {"done": int(done), "total": int(total)})
            self._paused += time.perf_counter() - now


def peak_memory() -> int:
    """Return the peak resident memory of this process, bytes."""
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    # Linux counts in KiB, macOS in bytes.
    return peak if sys.platform == "darwin" else peak * 1024
