"""How kernels are compiled (kept on disk, never with fast-math), and how threads share jobs."""

# Numba infers the types.
# mypy: allow-untyped-defs

from __future__ import annotations

import functools
from collections.abc import Callable
from typing import Any

from hwp_bench.base import kernels as compiler
from wildghand.splat.kernels.vectors import atomic_add_one


class Kernel:
    """A compiled function that Python calls; it releases the interpreter lock."""

    def __init__(self, function: Callable[..., Any]) -> None:
        functools.update_wrapper(self, function)
        self.dispatcher = compiler.compiled(nogil=True)(function)

    def __call__(self, *args: Any) -> Any:
        """Runs the machine code; compiles it if need be."""
        return self.dispatcher(*args)

    def on_disk(self) -> bool:
        """Whether the cache holds a version of this kernel, as far as can be told."""
        return compiler.on_disk(self.dispatcher)

    def compiled_here(self) -> int:
        """How many versions this process had to compile."""
        return len(self.dispatcher.signatures) - sum(self.dispatcher.stats.cache_hits.values())


def kernel(function: Callable[..., Any]) -> Kernel:
    """Decorator: compiles a function that Python calls."""
    return Kernel(function)


def inline(function: Callable[..., Any]) -> Any:
    """Decorator: compiles a function into the kernels that call it; Python cannot call it."""
    return compiler.helper(function, forceinline=True)


#: Numbers between two threads' counters: one cache line each.
SPACING = 8


@inline
def next_job(worker, counters, ends):
    """A job that nobody has taken yet, or -1.

    Args:
        worker: number of the calling thread.
        counters: int64 (threads * SPACING,), zeros to begin with; shared.
        ends: int64 (threads + 1,); thread w's own jobs are those from ends[w] to ends[w + 1].
    """
    threads = ends.size - 1
    for k in range(threads):
        owner = (worker + k) % threads
        size = ends[owner + 1] - ends[owner]
        if counters[owner * SPACING] < size:
            job = atomic_add_one(counters, owner * SPACING)
            if job < size:
                return ends[owner] + job
    return -1
