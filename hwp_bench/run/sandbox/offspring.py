"""End every descendant of this process, those in sessions of their own included."""

from __future__ import annotations

import contextlib
import os
import signal
import time

#: Most seconds that are spent on it; a storm of forks could go on for ever.
PATIENCE = 5.0


def end_descendants() -> None:
    """Kill children and their children until none is left.

    The process must have adopted its orphans, or those are out of reach.
    """
    deadline = time.monotonic() + PATIENCE
    while time.monotonic() < deadline:
        family = _descendants(os.getpid())
        for process in family:
            with contextlib.suppress(ProcessLookupError, PermissionError):
                os.kill(process, signal.SIGKILL)
        try:
            while os.waitpid(-1, os.WNOHANG)[0]:
                pass
        except ChildProcessError:
            return
        time.sleep(0.005)


def _descendants(root: int) -> list[int]:
    children: dict[int, list[int]] = {}
    for name in os.listdir("/proc"):
        if name.isdigit():
            with contextlib.suppress(OSError, ValueError, IndexError):
                with open(f"/proc/{name}/stat", "rb") as stream:
                    # The name in brackets may hold anything; the parent is two words after it.
                    parent = int(stream.read().rpartition(b")")[2].split()[1])
                children.setdefault(parent, []).append(int(name))
    found, new = [], [root]
    while new:
        new = [child for parent in new for child in children.get(parent, [])]
        found += new
    return found
