"""How kernels are compiled (kept on disk, never with fast-math), and how threads share jobs."""

# Numba infers the types.
# mypy: allow-untyped-defs

from __future__ import annotations

import functools

from hwp_bench.base.kernels import compiled, helper
from wildghand.splat.kernels.vectors import atomic_add_one

#: Decorator: a function that Python calls; it releases the interpreter lock.
kernel = compiled(nogil=True)
#: Decorator: a function that is compiled into the kernels that call it; Python cannot call it.
inline = functools.partial(helper, forceinline=True)

#: Numbers between two threads' counters: one cache line each.
SPACING = 8


@inline
def next_job(worker, counters, ends):
    """A job that nobody has taken yet, or -1.

    Args:
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


@inline
def jobs(worker, counters, ends):
    """The jobs that a thread gets, one after the other; see `next_job`."""
    while True:
        job = next_job(worker, counters, ends)
        if job < 0:
            break
        yield job
