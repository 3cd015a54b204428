"""All jobs in one view on standard error: which run where, how far they are, which have ended."""

from __future__ import annotations

import datetime
import time
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

from hwp_bench.base.progress import TerminalBar, notice

if TYPE_CHECKING:
    from rich.progress import ProgressColumn, TaskID


@dataclass
class _Line:
    """One job that runs."""

    text: str
    began: float = field(default_factory=time.perf_counter)
    task: TaskID | None = None


class JobsView(TerminalBar):
    """A bar for all jobs and one for each that runs; lines of text where there is no terminal.

    A context manager. `begin` says how many jobs there are; then every job is told of by its
    index, from any thread.
    """

    def __init__(self) -> None:
        super().__init__(_elapsed)
        self._lines: dict[int, _Line] = {}
        self._ended = 0
        self._count = 0
        self._began = time.perf_counter()

    def begin(self, count: int) -> None:
        """Say how many jobs there are."""
        self._count = count
        self._ended = 0
        self._began = time.perf_counter()
        self._lines.clear()
        if self._bar is not None:
            for task in self._bar.task_ids:
                self._bar.remove_task(task)
            self._all = self._bar.add_task("jobs", total=count)

    def start(self, index: int, text: str, place: str) -> None:
        """Say that a job begins at a place, or begins again at another."""
        again = index in self._lines
        self.drop(index)
        line = _Line(f"{text}, on {place}")
        self._lines[index] = line
        if self._bar is None or again:
            word = "again, its worker was lost: " if again else ""
            self._say(f"[{index + 1}/{self._count}] {word}{line.text}")
        if self._bar is not None:
            line.task = self._bar.add_task(f"  [{index + 1}] {line.text}", total=None)

    def steps(self, index: int, done: int, total: int) -> None:
        """Say how far a job is."""
        line = self._lines.get(index)
        if self._bar is not None and line is not None and line.task is not None:
            self._bar.update(line.task, completed=done, total=total)

    def end(self, index: int, text: str, problem: str | None = None) -> None:
        """Say that a job has ended, and why it failed if it did."""
        line = self._lines.get(index)
        self.drop(index)
        self._ended += 1
        took = "" if line is None else f" in {_clock(time.perf_counter() - line.began)}"
        if problem is not None:
            self._say(f"[{self._ended} of {self._count} ended] {text} failed: {problem}")
        elif self._bar is None:
            spent = _clock(time.perf_counter() - self._began)
            self._say(f"[{self._ended} of {self._count} ended, {spent} elapsed] {text}{took}")
        if self._bar is not None:
            self._bar.update(self._all, completed=self._ended)

    def say(self, text: str) -> None:
        """Tell a person something about the jobs."""
        self._say(text)

    def _say(self, text: str) -> None:
        if self._bar is None:
            notice(text)
        else:
            self._bar.console.print(text, markup=False, highlight=False)

    def drop(self, index: int) -> None:
        """Take a job out of the view that has not begun after all."""
        line = self._lines.pop(index, None)
        if line is not None and line.task is not None and self._bar is not None:
            self._bar.remove_task(line.task)


class NoView(JobsView):
    """Shows nothing."""

    def __init__(self) -> None:
        super().__init__()
        self._bar = None

    def _say(self, text: str) -> None:
        pass


def _elapsed() -> list[ProgressColumn]:
    from rich.progress import TimeElapsedColumn

    return [TimeElapsedColumn()]


def _clock(seconds: float) -> str:
    return str(datetime.timedelta(seconds=round(seconds)))
