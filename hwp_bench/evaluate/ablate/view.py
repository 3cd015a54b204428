"""Progress of an ablation: what runs, how much is done, how long the rest may take."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING

from hwp_bench.base.progress import TerminalBar, notice

if TYPE_CHECKING:
    from rich.progress import ProgressColumn

#: Jobs that took less than this share of the longest were found finished; they tell nothing.
FOUND = 0.1


def remaining(durations: Sequence[float], left: int) -> float | None:
    """Estimate the seconds that are left.

    Args:
        durations: seconds of the jobs that have ended.
        left: jobs that have not ended.

    Returns:
        The mean of the jobs that ran, times those left; None before the first has ended.
    """
    ran = [spent for spent in durations if spent >= FOUND * max(durations)]
    return left * sum(ran) / len(ran) if ran else None


def clock(seconds: float) -> str:
    """Return seconds as `m:ss` or `h:mm:ss`."""
    minutes, rest = divmod(round(seconds), 60)
    hours, minutes = divmod(minutes, 60)
    return f"{hours}:{minutes:02d}:{rest:02d}" if hours else f"{minutes}:{rest:02d}"


def _own_times() -> list[ProgressColumn]:
    from rich.progress import TextColumn

    return [TextColumn("{task.fields[times]}", markup=False)]


class AblationView(TerminalBar):
    """A bar on a terminal, a line a job elsewhere; a context manager."""

    def __init__(self) -> None:
        super().__init__(_own_times)
        self._began = time.perf_counter()
        self._job_began: float | None = None
        self._durations: list[float] = []
        if self._bar is not None:
            self._task = self._bar.add_task("", total=None, times="")

    def start(self, index: int, count: int, text: str) -> Callable[[int, int], None]:
        """Begin job `index` of `count`; returns what takes (done, total) steps of it."""
        now = time.perf_counter()
        if self._job_began is not None:
            self._durations.append(now - self._job_began)
        self._job_began = now
        left = remaining(self._durations, count - index)
        if self._bar is None:
            notice(f"[{index + 1}/{count}] {text} ({self._times(left)})")
            return lambda done, total: None
        self._show(text, index, count, left)
        return lambda done, total: self._show(f"{text}, step {done}/{total}", index, count, left)

    def _show(self, text: str, index: int, count: int, left: float | None) -> None:
        assert self._bar is not None
        spent = time.perf_counter() - (self._job_began or 0.0)
        now_left = None if left is None else max(left - spent, 0.0)
        self._bar.update(
            self._task,
            description=text,
            completed=index,
            total=count,
            times=self._times(now_left),
        )

    def _times(self, left: float | None) -> str:
        elapsed = clock(time.perf_counter() - self._began)
        return f"{elapsed} elapsed" + ("" if left is None else f", about {clock(left)} left")
