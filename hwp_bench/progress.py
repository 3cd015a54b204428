"""Progress and notices on standard error, so that standard output stays the result."""

from __future__ import annotations

import contextlib
import sys
import time
from collections.abc import Callable, Iterable, Iterator
from typing import TypeVar

Item = TypeVar("Item")


def notice(text: str) -> None:
    """Print one line for a person on standard error."""
    print(text, file=sys.stderr, flush=True)


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
    from rich.console import Console
    from rich.progress import (
        BarColumn,
        MofNCompleteColumn,
        Progress,
        TextColumn,
        TimeElapsedColumn,
        TimeRemainingColumn,
    )

    columns = (
        TextColumn("{task.description}"),
        BarColumn(),
        MofNCompleteColumn(),
        TimeElapsedColumn(),
        TextColumn("elapsed,"),
        TimeRemainingColumn(),
        TextColumn("left"),
    )
    with Progress(*columns, console=Console(stderr=True)) as bar:
        task = bar.add_task(description, total=total)
        yield lambda done: bar.update(task, completed=done)


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
