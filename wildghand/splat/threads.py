"""Runs a kernel on several threads, and lends it memory.

Kernels release the interpreter lock and share out their jobs themselves (see `kernels.jit`), so
any threads do. The best are those of torch's own OpenMP, which are there already. In a process
that loaded torch before `hwp_bench` they spin for some milliseconds after an operation of torch,
and threads of ours would have to compete with them for the cores. Where torch has no OpenMP, in a
forked child, whose OpenMP is dead, and on a machine that is busy otherwise, plain threads take
their place. Numba's own layers cannot be used: they forbid two callers at once or end the process
on a fork.

How many threads: `torch.get_num_threads()`, or fewer where `at_most` says so. Results do not depend
on it. All of them treat denormal numbers as the calling thread does.
"""

from __future__ import annotations

import ctypes
import functools
import math
import multiprocessing
import os
import time
from collections import defaultdict, deque
from collections.abc import Callable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import contextmanager
from contextvars import ContextVar
from pathlib import Path
from typing import Any

import numpy as np
import torch

from hwp_bench.base.numerics import flushes, set_flush
from wildghand.splat.kernels.jit import SPACING

#: Work, in Gaussians or (Gaussian, tile) pairs, that outweighs waking a thread (some 0.1 ms).
WORTH_A_THREAD = 4096

#: The process that imported this; a forked child is another.
_PROCESS = os.getpid()
#: Most threads of kernels that are called in a context; None: as many as torch has.
_MOST: ContextVar[int | None] = ContextVar("most threads", default=None)
_TEAM_MEMBER = ctypes.CFUNCTYPE(None, ctypes.c_void_p)


def thread_count(jobs: int, work: int | None = None) -> int:
    """Threads worth using for so many jobs that are like `work` Gaussians or pairs.

    Without `work` every job is worth a thread.
    """
    worth = jobs if work is None else min(jobs, work // WORTH_A_THREAD)
    return max(1, min(torch.get_num_threads(), _MOST.get() or worth, worth))


@contextmanager
def at_most(threads: int | None) -> Iterator[None]:
    """Bound the threads of kernels that are called while this holds; results stay the same.

    torch's own operations keep their number, on which their last bits depend.
    """
    token = _MOST.set(threads)
    try:
        yield
    finally:
        _MOST.reset(token)


def even_jobs(jobs: int, threads: int) -> np.ndarray:
    """Equal shares of equal jobs: thread w begins with those from [w] to [w + 1]."""
    return np.arange(threads + 1) * jobs // threads


def weighted_jobs(before: np.ndarray, threads: int) -> np.ndarray:
    """Equal shares of unequal jobs, by (jobs + 1,) work before each, and of all."""
    if threads == 1:
        return np.array([0, len(before) - 1])
    goals = np.arange(1, threads) * (before[-1] / threads)
    inner = np.searchsorted(before, goals)
    return np.concatenate(([0], inner, [len(before) - 1])).astype(np.int64)


def kernels_take(*tensors: torch.Tensor) -> bool:
    """Whether compiled kernels can read these tensors: float32 on the CPU."""
    return all(t.dtype == torch.float32 and t.device.type == "cpu" for t in tensors)


def piece_count(count: int, piece: int) -> int:
    """Pieces of at most `piece` things that `count` things make."""
    return -(-count // piece)


def run_pieces(kernel: Callable[..., Any], count: int, piece: int, work: int, *args: Any) -> None:
    """Call a kernel whose job k does at most `piece` items, from item `piece * k`."""
    run_jobs(kernel, piece_count(count, piece), work, *args)


def run_jobs(kernel: Callable[..., Any], jobs: int, work: int, *args: Any) -> None:
    """Call a kernel whose jobs are alike, see `run`; all are like `work` Gaussians or pairs."""
    run(kernel, even_jobs(jobs, thread_count(jobs, work)), *args)


def run(kernel: Callable[..., Any], ends: np.ndarray, *args: Any) -> None:
    """Calls `kernel(worker, counters, ends, *args)` on as many threads as there are shares.

    Args:
        ends: int64 (threads + 1,), the shares; the calling thread has the first.
    """
    threads = len(ends) - 1
    counters = np.zeros(threads * SPACING, np.int64)
    if threads == 1:
        kernel(0, counters, ends, *args)
        return
    failures: list[BaseException] = []
    flush = flushes()

    def work(worker: int) -> None:
        try:
            set_flush(flush)
            kernel(worker, counters, ends, *args)
        except BaseException as error:  # it must not unwind into the threads' own code
            failures.append(error)

    team = _openmp() if _may_use_openmp() and not _crowded(int(time.monotonic())) else None
    if team is not None:
        team(work, threads)
    else:
        _plain_threads(work, threads)
    if failures:
        raise failures[0]


@contextmanager
def denormals_flushed() -> Iterator[None]:
    """Flush denormals in the calling thread and in the threads of torch's team while this holds.

    For the entrances of a library: whoever imports it finds every thread as before.
    """
    before: dict[int, bool] = {}

    def enter(worker: int) -> None:
        before[worker] = set_flush(True)

    def leave(worker: int) -> None:
        # A thread that has joined the team meanwhile took over the switch of its starter.
        set_flush(before.get(worker, before[0]))

    _on_torch_threads(enter, 1)
    try:
        yield
    finally:
        _on_torch_threads(leave, len(before))


def _on_torch_threads(work: Callable[[int], None], least: int) -> None:
    """Call a function once on every thread that torch's operators use, with the thread's number."""
    threads = max(torch.get_num_threads(), least)
    team = _openmp() if threads > 1 and _may_use_openmp() else None
    if team is None:
        work(0)
    else:
        team(work, threads)


def _may_use_openmp() -> bool:
    forked = multiprocessing.parent_process() is not None
    forked = forked and multiprocessing.get_start_method(allow_none=True) in (None, "fork")
    return os.getpid() == _PROCESS and not forked


@functools.lru_cache(maxsize=1)
def _crowded(second: int) -> bool:
    """Whether other processes want the cores, asked at most once a second.

    Threads that spin then take time from those that they wait for: a step of 5 ms took 100 ms
    next to one busy process of two threads.
    """
    try:
        return os.getloadavg()[0] > (os.cpu_count() or 1) + 0.5
    except (AttributeError, OSError):  # no such number here
        return False


@functools.cache
def _openmp() -> Callable[[Callable[[int], None], int], None] | None:
    """Runs a function on a team of torch's OpenMP threads; None if there is none.

    `GOMP_parallel` is the call that compilers make of `#pragma omp parallel`; GNU's, LLVM's and
    Intel's runtimes have it. Only a runtime that torch has already loaded is used.
    """
    if not torch.backends.openmp.is_available() or not hasattr(os, "RTLD_NOLOAD"):
        return None
    folder = Path(torch.__file__).parent / "lib"
    found = [path for kind in ("libgomp", "libiomp5", "libomp") for path in folder.glob(kind + "*")]
    for name in [*map(str, found), "libgomp.so.1", "libiomp5.so", "libomp.so"]:
        try:
            library = ctypes.CDLL(name, mode=os.RTLD_NOLOAD | os.RTLD_NOW)
            parallel, thread_number = library.GOMP_parallel, library.omp_get_thread_num
        except (OSError, AttributeError):
            continue
        parallel.argtypes = [_TEAM_MEMBER, ctypes.c_void_p, ctypes.c_uint, ctypes.c_uint]
        parallel.restype = None

        def team(
            work: Callable[[int], None],
            threads: int,
            parallel: Any = parallel,
            thread_number: Any = thread_number,
        ) -> None:
            member = _TEAM_MEMBER(lambda data: work(thread_number()))
            parallel(member, None, threads, 0)

        return team
    return None


def _plain_threads(work: Callable[[int], None], threads: int) -> None:
    # Not the pool's own futures: where no thread can be started it gives none, yet one of its
    # threads may still begin what was handed over.
    helpers: list[Future[None]] = [Future() for _ in range(1, threads)]
    try:
        pool = _pool(os.getpid(), max(torch.get_num_threads(), threads) - 1)
        for worker, helper in enumerate(helpers, start=1):
            pool.submit(_help, helper, work, worker)
    except RuntimeError:
        pass  # the interpreter is shutting down, or no more threads can be started
    work(0)
    for helper in helpers:
        if not helper.cancel():  # one that has not begun is not needed: the jobs are all taken
            helper.result()


def _help(helper: Future[None], work: Callable[[int], None], worker: int) -> None:
    """Do a worker's part, unless the caller has done it meanwhile."""
    if helper.set_running_or_notify_cancel():
        try:
            work(worker)
        except BaseException as error:  # for the caller
            helper.set_exception(error)
        else:
            helper.set_result(None)


@functools.lru_cache(maxsize=2)
def _pool(process: int, threads: int) -> ThreadPoolExecutor:
    """The helpers of this process: threads do not survive a fork, so a child starts its own."""
    return ThreadPoolExecutor(threads, thread_name_prefix="splat")


# Large buffers are used again: fresh memory costs a page fault for every 4 KiB, and a call of the
# rasterizer needs some 10 MB for a moment, thousands of times. A buffer belongs to whoever leased
# it until the last array that looks into it is gone; only then is it kept for the next lease. So
# two calls never share memory, whatever the order in which they end.

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
