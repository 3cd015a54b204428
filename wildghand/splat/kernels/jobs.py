"""How the threads that run a kernel share out its jobs.

Each thread has jobs of its own, neighbours, and takes those of others when it has done them. So
from stage to stage the same core works on the same Gaussians and tiles, whose data it still
holds: sharing out job by job costs as much in traffic between cores as a second core gains.
"""

# Numba infers the types.
# mypy: allow-untyped-defs

from __future__ import annotations

from wildghand.splat.kernels.jit import inline
from wildghand.splat.kernels.lanes import atomic_add_one

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
