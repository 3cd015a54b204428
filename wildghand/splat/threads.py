"""Runs a kernel on several threads.

Kernels release the interpreter lock and share out their work by an atomic counter, so plain
threads do; numba's own layers either forbid two callers at once or end the process on a fork.
How many: `torch.get_num_threads()`, which is how users of torch say it. Results do not depend
on it.
"""

from __future__ import annotations

import functools
import os
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import numpy as np
import torch

#: Work, in Gaussians or (Gaussian, tile) pairs, that outweighs waking a thread (some 0.1 ms).
WORTH_A_THREAD = 4096


def thread_count(jobs: int, work: int | None = None) -> int:
    """Threads worth using.

    Args:
        jobs: pieces into which the work is cut.
        work: how many Gaussians or pairs it is; None if every job is worth a thread.
    """
    worth = jobs if work is None else min(jobs, work // WORTH_A_THREAD)
    return max(1, min(torch.get_num_threads(), worth))


def run(kernel: Callable[..., Any], threads: int, *args: Any) -> None:
    """Calls `kernel(counter, *args)` on `threads` threads and waits for all of them.

    Args:
        kernel: takes jobs by adding to `counter`, an int64 array of one zero, until none is left.
        threads: the calling thread included.
        args: the same for all.
    """
    counter = np.zeros(1, np.int64)
    if threads == 1:
        kernel(counter, *args)
        return
    try:
        pool = _pool(os.getpid(), threads - 1)
        helpers = [pool.submit(kernel, counter, *args) for _ in range(threads - 1)]
    except RuntimeError:  # the interpreter is shutting down, or no thread can be started
        helpers = []
    try:
        kernel(counter, *args)
    finally:
        # One that has not begun is not needed: the jobs are all taken.
        failures = [helper.exception() for helper in helpers if not helper.cancel()]
    for failure in failures:
        if failure is not None:
            raise failure


@functools.lru_cache(maxsize=8)
def _pool(process: int, threads: int) -> ThreadPoolExecutor:
    """The helpers of this process: threads do not survive a fork, so a child starts its own."""
    return ThreadPoolExecutor(threads, thread_name_prefix="splat")
