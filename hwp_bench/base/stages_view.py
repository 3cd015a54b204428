"""Stages of unequal length on standard error, with what is left of all of them."""

from __future__ import annotations

import contextlib
import sys
import time
from collections.abc import Callable, Iterator
from contextvars import Token
from typing import TYPE_CHECKING, Self

from hwp_bench.base.console import on_terminal
from hwp_bench.base.progress import OUTER, Shows, clock, left_text, new_bars, notice, update_bar

if TYPE_CHECKING:
    from rich.progress import TaskID


class StagesView:
    """Shows stages of unequal length, one after the other, and how much is left of all.

    On a terminal one bar for all of them, and below it those that `progress` and `track` show
    within a stage; elsewhere a line at the beginning of each. A context manager.
    """

    def __init__(self) -> None:
        self._bars = new_bars() if on_terminal(sys.stderr) else None
        self._all: TaskID | None = None
        self._began = self._stage_began = time.perf_counter()
        self._left: tuple[float, float] = (0.0, 0.0)
        self._outer: Token[Shows | None] | None = None

    def __enter__(self) -> Self:
        if self._bars is not None:
            self._bars.start()
            self._outer = OUTER.set(self.part)
        return self

    def __exit__(self, *_: object) -> None:
        if self._outer is not None:
            OUTER.reset(self._outer)
        if self._bars is not None:
            self._bars.stop()

    def stage(self, number: int, count: int, text: str, *, own: float, later: float) -> None:
        """Begin a stage.

        Args:
            number: of the stage, from 1.
            count: of all stages.
            text: what is done.
            own: seconds that it is expected to take.
            later: seconds that those after it are expected to take.
        """
        self._stage_began = time.perf_counter()
        self._left = (own, later)
        elapsed = clock(self._stage_began - self._began)
        line = f"[{number}/{count}] {text}"
        if self._bars is None:
            notice(f"{line} ({elapsed} elapsed{left_text(own + later)})")
            return
        if self._all is None:
            self._all = self._bars.add_task(line, total=count, left="")
        self._bars.update(self._all, description=line, total=count, completed=number - 1)
        self._tell()

    @contextlib.contextmanager
    def part(self, description: str, total: int) -> Iterator[Callable[[int], None]]:
        """Show a piece of the stage as a bar of its own; see `progress`."""
        assert self._bars is not None
        bars, start = self._bars, time.perf_counter()
        task = bars.add_task(f"  {description}", total=total, left="")

        def update(done: int) -> None:
            update_bar(bars, task, start, done, total)
            self._tell()

        try:
            yield update
        finally:
            bars.remove_task(task)

    def _tell(self) -> None:
        """Say how much is left: of this stage what it has not used yet, and the later ones."""
        if self._bars is not None and self._all is not None:
            own, later = self._left
            left = max(own - (time.perf_counter() - self._stage_began), 0.0) + later
            self._bars.update(self._all, left=left_text(left))
