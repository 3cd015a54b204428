"""Progress and notices on standard error, so that standard output stays the result.

On a terminal work is shown as bars; elsewhere (logs, CI) as a few lines of text. One piece of work
is shown by `progress` or `track`, a list of jobs by `JobsView`, stages of unequal length by
`hwp_bench.base.stages_view`.
"""

from __future__ import annotations

import contextlib
import sys
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextvars import ContextVar
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Self, TypeVar

from hwp_bench.base.console import on_terminal, tell
from hwp_bench.base.text import shown

if TYPE_CHECKING:
    from rich.progress import Progress, TaskID

Item = TypeVar("Item")
#: What `progress` does: takes a description and a total, yields a function that takes how many
#: steps are done.
Shows = Callable[[str, int], contextlib.AbstractContextManager[Callable[[int], None]]]

#: A display on the terminal around the pieces of work of this context, which shows them itself:
#: two displays would overwrite each other.
OUTER: ContextVar[Shows | None] = ContextVar("outer", default=None)

#: Jobs that took less than this share of the longest one were found finished; an estimate of the
#: remaining time leaves them out.
FOUND = 0.1


def notice(text: str) -> None:
    """Print a line for a person on standard error; what could steer a terminal becomes `?`.

    Where nobody reads it any more it is dropped, and the work goes on.
    """
    tell(shown(text))


def clock(seconds: float) -> str:
    """Return seconds as `m:ss` or `h:mm:ss`."""
    minutes, rest = divmod(round(seconds), 60)
    hours, minutes = divmod(minutes, 60)
    return f"{hours}:{minutes:02d}:{rest:02d}" if hours else f"{minutes}:{rest:02d}"


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


@contextlib.contextmanager
def progress(description: str, total: int) -> Iterator[Callable[[int], None]]:
    """Show how far a piece of work is, with elapsed and remaining time.

    On a terminal a bar; elsewhere one line when the work ends, which says how much of it was done.

    Args:
        description: what is being done.
        total: number of steps.

    Yields:
        A function that takes the number of steps that are done by now.
    """
    start = time.perf_counter()
    outer = OUTER.get()
    if outer is not None:
        with outer(description, total) as update:
            yield update
        return
    if not on_terminal(sys.stderr):
        reached = 0

        def reach(done: int) -> None:
            nonlocal reached
            reached = done

        yield reach
        # Work may end early: by its budget, or because nothing gets better any more.
        share = f"{total}" if reached == total else f"{reached} of {total}"
        notice(f"{description}: {share} in {time.perf_counter() - start:.1f} s")
        return
    with new_bars() as bars:
        task = bars.add_task(description, total=total, left="")
        yield lambda done: update_bar(bars, task, start, done, total)


def track(items: Iterable[Item], description: str, total: int | None = None) -> Iterator[Item]:
    """Yield the items and show progress over them.

    Args:
        items: what is worked through.
        description: what is being done.
        total: number of items, needed when `items` has no length.
    """
    count = total if total is not None else len(items)  # type: ignore[arg-type]
    with progress(description, count) as update:
        for done, item in enumerate(items, start=1):
            yield item
            update(done)


class JobsView:
    """Shows jobs: a bar for all of them and one for each that runs.

    Elsewhere than on a terminal a line of text says that a job begins, and one that it has ended.
    A context manager. Jobs that run one after another are told to `turn`. An engine that runs
    several at once calls `begin`, then `start`, `steps`, `end` and `drop` with the index of a job,
    from any thread.

    Args:
        quiet: show nothing.
    """

    def __init__(self, *, quiet: bool = False) -> None:
        self._quiet = quiet
        self._bars = new_bars() if on_terminal(sys.stderr) and not quiet else None
        self._all: TaskID | None = None
        self._running: dict[int, _Running] = {}
        self._durations: list[float] = []
        self._count = self._ended = 0
        self._began = time.perf_counter()

    def __enter__(self) -> Self:
        if self._bars is not None:
            self._bars.start()
        return self

    def __exit__(self, *_: object) -> None:
        if self._bars is not None:
            self._bars.stop()

    def turn(self, index: int, count: int, text: str) -> Callable[[int, int], None]:
        """Begin job `index` of `count`, after the one before it has ended.

        Returns:
            A function that takes (done, total) steps of the job.
        """
        if index == 0 or count != self._count:
            self.begin(count)
        for other in list(self._running):
            self._durations.append(self.drop(other) or 0.0)
        self._ended = index
        left = remaining(self._durations, count - index)
        about = "" if left is None else f", about {clock(left)} left"
        if self._bars is None:
            elapsed = clock(time.perf_counter() - self._began)
            self.say(f"[{index + 1}/{count}] {text} ({elapsed} elapsed{about})")
        self._add(index, text)
        return lambda done, total: self.steps(index, done, total)

    def begin(self, count: int) -> None:
        """Say how many jobs there are."""
        self._count, self._ended = count, 0
        self._began = time.perf_counter()
        self._running.clear()
        self._durations.clear()
        if self._bars is not None:
            for task in self._bars.task_ids:
                self._bars.remove_task(task)
            self._all = self._bars.add_task("jobs", total=count, left="")

    def start(self, index: int, text: str, place: str) -> None:
        """Say that a job begins at a place, or begins again at another."""
        again = self.drop(index) is not None
        text = f"{text}, on {place}"
        if self._bars is None or again:
            word = "again, its worker was lost: " if again else ""
            self.say(f"[{index + 1}/{self._count}] {word}{text}")
        self._add(index, text)

    def steps(self, index: int, done: int, total: int) -> None:
        """Say how far a job is."""
        job = self._running.get(index)
        if self._bars is not None and job is not None and job.task is not None:
            update_bar(self._bars, job.task, job.began, done, total)
            self._update_all()

    def end(self, index: int, text: str, problem: str | None = None) -> None:
        """Say that a job has ended, and why it failed if it did."""
        spent = self.drop(index)
        self._ended += 1
        if spent is not None:
            self._durations.append(spent)
        took = "" if spent is None else f" in {clock(spent)}"
        if problem is not None:
            self.say(f"[{self._ended} of {self._count} ended] {text} failed: {problem}")
        elif self._bars is None:
            elapsed = clock(time.perf_counter() - self._began)
            self.say(f"[{self._ended} of {self._count} ended, {elapsed} elapsed] {text}{took}")
        self._update_all()

    def say(self, text: str) -> None:
        """Tell a person something about the jobs."""
        if self._bars is not None:
            self._bars.console.print(text, markup=False, highlight=False)
        elif not self._quiet:
            notice(text)

    def drop(self, index: int) -> float | None:
        """Take a job out of the view; returns the seconds that it ran, None if it did not."""
        job = self._running.pop(index, None)
        if job is None:
            return None
        if job.task is not None and self._bars is not None:
            self._bars.remove_task(job.task)
        return time.perf_counter() - job.began

    def _add(self, index: int, text: str) -> None:
        job = self._running[index] = _Running()
        if self._bars is not None:
            job.task = self._bars.add_task(f"  [{index + 1}] {text}", total=None, left="")
        self._update_all()

    def _update_all(self) -> None:
        if self._bars is None or self._all is None:
            return
        left = remaining(self._durations, self._count - self._ended)
        if left is not None and self._running:
            now = time.perf_counter()
            spent = sum(now - job.began for job in list(self._running.values()))
            left = max(left - spent, 0.0) / len(self._running)
        self._bars.update(self._all, completed=self._ended, left=left_text(left))


@dataclass
class _Running:
    """A job that runs."""

    began: float = field(default_factory=lambda: time.perf_counter())
    task: TaskID | None = None


def new_bars() -> Progress:
    """Return an empty display of bars on standard error; each has a field `left`."""
    from rich.console import Console
    from rich.progress import (
        BarColumn,
        MofNCompleteColumn,
        Progress,
        TextColumn,
        TimeElapsedColumn,
    )

    return Progress(
        TextColumn("{task.description}", markup=False),
        BarColumn(),
        MofNCompleteColumn(),
        TimeElapsedColumn(),
        TextColumn("elapsed{task.fields[left]}", markup=False),
        console=Console(stderr=True),
    )


def update_bar(bars: Progress, task: TaskID, began: float, done: int, total: int) -> None:
    """Show how far a bar is, and what is left at the pace since `began` (`time.perf_counter`)."""
    left = (time.perf_counter() - began) * (total - done) / done if done else None
    bars.update(task, completed=done, total=total, left=left_text(left))


def left_text(seconds: float | None) -> str:
    """Return the words for the seconds that are left, to follow those that have passed."""
    return "" if seconds is None else f", about {clock(seconds)} left"
