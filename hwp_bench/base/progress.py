"""Progress and notices on standard error, so that standard output stays the result."""

from __future__ import annotations

import contextlib
import sys
import time
from collections.abc import Callable, Iterable, Iterator
from typing import TYPE_CHECKING, Self, TypeVar

from hwp_bench.base.text import shown

if TYPE_CHECKING:
    from rich.progress import Progress, ProgressColumn

Item = TypeVar("Item")


def notice(text: str) -> None:
    """Print one line for a person on standard error; what steers a terminal is taken out."""
    print(shown(text), file=sys.stderr, flush=True)


def _bar(*more: ProgressColumn) -> Progress:
    from rich.console import Console
    from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn

    return Progress(
        TextColumn("{task.description}", markup=False),
        BarColumn(),
        MofNCompleteColumn(),
        *more,
        console=Console(stderr=True),
    )


def _times() -> list[ProgressColumn]:
    from rich.progress import TextColumn, TimeElapsedColumn, TimeRemainingColumn

    return [
        TimeElapsedColumn(),
        TextColumn("elapsed,"),
        TimeRemainingColumn(),
        TextColumn("left"),
    ]


class TerminalBar:
    """A bar that only a terminal gets; a context manager.

    Args:
        columns: makes the columns behind the count; called, and rich imported, on a terminal only.
    """

    def __init__(self, columns: Callable[[], Iterable[ProgressColumn]]) -> None:
        self._bar = _bar(*columns()) if sys.stderr.isatty() else None

    def __enter__(self) -> Self:
        if self._bar is not None:
            self._bar.start()
        return self

    def __exit__(self, *_: object) -> None:
        if self._bar is not None:
            self._bar.stop()


@contextlib.contextmanager
def progress(description: str, total: int) -> Iterator[Callable[[int], None]]:
    """Show how far a piece of work is, with elapsed and remaining time.

    On a terminal a rich bar; elsewhere (logs, CI) one line when the work ends.

    Args:
        description: what is being done.
        total: number of steps.

    Yields:
        A function that takes the number of steps that are done by now.
    """
    start = time.perf_counter()
    if not sys.stderr.isatty():
        yield lambda done: None
        notice(f"{description}: {total} in {time.perf_counter() - start:.1f} s")
        return
    with _bar(*_times()) as bar:
        task = bar.add_task(description, total=total)
        yield lambda done: bar.update(task, completed=done)


class JobProgress(TerminalBar):
    """Shows a list of jobs, one bar each, with elapsed and remaining time.

    A context manager; elsewhere than on a terminal it prints one line as each job starts.
    """

    def __init__(self) -> None:
        super().__init__(_times)

    def start(self, index: int, count: int, name: str) -> Callable[[int, int], None]:
        """Begin job `index` of `count`; returns what takes (done, total) steps of it."""
        description = f"[{index + 1}/{count}] {name}"
        bar = self._bar
        if bar is None:
            notice(description)
            return lambda done, total: None
        task = bar.add_task(description, total=None)
        return lambda done, total: bar.update(task, completed=done, total=total)


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
