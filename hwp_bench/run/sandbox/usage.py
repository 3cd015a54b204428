"""Processes below another one, and the memory that they hold together."""

from __future__ import annotations

import contextlib
from collections.abc import Sequence
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    import psutil


def processes_of(root: int) -> list[psutil.Process]:
    """Return the running descendants of a process, as far as the system shows them."""
    import psutil

    with contextlib.suppress(psutil.Error):
        return psutil.Process(root).children(recursive=True)
    return []


def memory_of(processes: Sequence[psutil.Process], enough: int) -> int:
    """Return the memory of some processes together, bytes.

    What they share is counted once. That is slow to find out, so it is looked at only where the
    plain sum, which is never smaller, lies above `enough`.
    """
    total = sum(_resident(process) for process in processes)
    return total if total <= enough else sum(_proportional(process) for process in processes)


def _resident(process: psutil.Process) -> int:
    import psutil

    with contextlib.suppress(psutil.Error):
        return process.memory_info().rss
    return 0


def _proportional(process: psutil.Process) -> int:
    import psutil

    with contextlib.suppress(psutil.Error, AttributeError):
        return process.memory_full_info().pss
    return _resident(process)
