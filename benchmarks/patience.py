"""Waits that a busy machine does not fail: they count what a process does, not the seconds.

A process that gets little of the processor still gets some. So one is stuck where it and all that
it started use none for minutes, or where they have used far more than the work can need.
"""

from __future__ import annotations

import math
import subprocess
import tempfile
import time
from collections.abc import Callable, Sequence
from pathlib import Path

import psutil

#: Seconds without any use of the processor after which nothing more is hoped for.
IDLE = 300.0


class Stuck(AssertionError):
    """Nothing happens any more, or it does not end."""


class Patience:
    """Says when a wait has become hopeless.

    Args:
        spent: the processor seconds of what is waited for.
        idle: seconds in which they may stay the same.
        most: how many there may be, counted from now.
        clock: seconds by the clock.
    """

    def __init__(
        self,
        spent: Callable[[], float],
        *,
        idle: float = IDLE,
        most: float = math.inf,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        self._spent = spent
        self._idle = idle
        self._clock = clock
        self._last = spent()
        self._end = self._last + most
        self._since = clock()

    def check(self) -> None:
        """Look at it once more.

        Raises:
            Stuck: it has done nothing for too long, or too much.
        """
        now = self._spent()
        if now > self._end:
            raise Stuck(f"it has not ended after {now:.0f} s of the processor")
        if now > self._last:
            self._last, self._since = now, self._clock()
        elif self._clock() - self._since > self._idle:
            raise Stuck(f"it has not used the processor for {self._idle:g} s")


def spent_by(pid: int) -> Callable[[], float]:
    """Return a function that gives the processor seconds of a process and of all that it started.

    What has ended counts as it was last seen, so that the sum never falls.
    """
    seen: dict[int, float] = {}

    def spent() -> float:
        try:
            root = psutil.Process(pid)
            family = [root, *root.children(recursive=True)]
        except psutil.NoSuchProcess:
            family = []
        for process in family:
            try:
                times = process.cpu_times()
            except psutil.Error:
                continue
            seen[process.pid] = max(seen.get(process.pid, 0.0), times.user + times.system)
        return sum(seen.values())

    return spent


def finish(process: subprocess.Popen[bytes], *, idle: float = IDLE, most: float = math.inf) -> int:
    """Wait until a process ends; returns its exit status.

    Raises:
        Stuck: see `Patience`; the process has been killed.
    """
    patience = Patience(spent_by(process.pid), idle=idle, most=most)
    while True:
        try:
            return process.wait(0.5)
        except subprocess.TimeoutExpired:
            try:
                patience.check()
            except Stuck:
                process.kill()
                process.wait()
                raise


def run(
    words: Sequence[str],
    *,
    cwd: Path | None = None,
    idle: float = IDLE,
    most: float = math.inf,
) -> subprocess.CompletedProcess[str]:
    """Run a command to its end and return what it said, as `subprocess.run` does.

    Raises:
        Stuck: see `Patience`.
    """
    # Files and no pipes: what a killed process has started would keep a pipe open.
    with tempfile.TemporaryFile() as out, tempfile.TemporaryFile() as err:
        status = finish(
            subprocess.Popen(words, cwd=cwd, stdout=out, stderr=err), idle=idle, most=most
        )
        said = []
        for file in (out, err):
            file.seek(0)
            said.append(file.read().decode(errors="replace"))
    return subprocess.CompletedProcess(words, status, *said)
