"""Large buffers that are used again: fresh memory costs a page fault for every 4 KiB.

A call of the rasterizer needs some 10 MB for a moment, thousands of times. A buffer belongs to
whoever leased it until the last array that looks into it is gone; only then is it kept for the
next lease. So two calls never share memory, whatever the order in which they end.
"""

from __future__ import annotations

import math
from collections import defaultdict, deque
from typing import Any

import numpy as np

#: Bytes of idle buffers that are kept at most.
MAX_IDLE = 256 << 20
#: Buffers start on a cache line, which is also the widest vector.
_ALIGNMENT = 64
#: The C library keeps buffers below this many bytes by itself.
_SMALL = 1 << 15

_idle: defaultdict[int, deque[np.ndarray]] = defaultdict(deque)


class _Lease:
    """Owner of one buffer; numpy arrays that look into it hold it as their base."""

    def __init__(self, memory: np.ndarray) -> None:
        self._memory = memory

    @property
    def __array_interface__(self) -> dict[str, Any]:
        return self._memory.__array_interface__

    def __del__(self) -> None:
        if idle_bytes is None or idle_bytes() + self._memory.nbytes > MAX_IDLE:  # or at exit
            return
        _idle[self._memory.nbytes].append(self._memory)


def lease(shape: tuple[int, ...], kind: type[np.generic]) -> np.ndarray:
    """An array of that shape, with whatever was there before in it; a large one on a cache line."""
    size = math.prod(shape) * np.dtype(kind).itemsize
    if size < _SMALL:
        return np.empty(shape, kind)
    room = _size_class(size)
    try:
        memory = _idle[room].pop()
    except IndexError:
        raw = np.empty(room + _ALIGNMENT, np.uint8)
        memory = raw[-raw.ctypes.data % _ALIGNMENT :][:room]
    return np.asarray(_Lease(memory))[:size].view(kind).reshape(shape)


def idle_bytes() -> int:
    """Bytes held for later leases."""
    return sum(size * len(buffers) for size, buffers in list(_idle.items()))


def _size_class(size: int) -> int:
    """The next of a power of two times 1, 1.25, 1.5, 1.75: few sizes, at most 25 % waste."""
    step = 1 << (size - 1).bit_length() - 3
    return -(-size // step) * step
