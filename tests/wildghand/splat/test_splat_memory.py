"""Leased buffers never overlap while in use; threads share out every job once."""

from __future__ import annotations

import gc
import threading
import time
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from wildghand.splat import threads as memory
from wildghand.splat.kernels import jit
from wildghand.splat.kernels.jit import SPACING, next_job
from wildghand.splat.threads import even_jobs, lease, run, thread_count, weighted_jobs


@settings(max_examples=50, deadline=None)
@given(st.lists(st.tuples(st.integers(0, 200_000), st.booleans()), max_size=12))
def test_buffers_in_use_do_not_overlap(steps: list[tuple[int, bool]]) -> None:
    held: list[tuple[np.ndarray, int]] = []
    for number, (size, keep) in enumerate(steps):
        array = lease((size,), np.int32)
        assert array.shape == (size,)
        assert array.dtype == np.int32
        array[:] = number
        if keep:
            held.append((array, number))
    for array, number in held:
        assert (array == number).all()


def test_a_buffer_comes_back_when_the_last_view_is_gone() -> None:
    first = lease((300_000,), np.float32)
    address = first.ctypes.data
    assert address % 64 == 0
    tensor = torch.from_numpy(first)[10:]
    del first
    gc.collect()
    other = lease((300_000,), np.float32)
    assert other.ctypes.data != address
    tensor.fill_(1.0)
    del tensor
    gc.collect()
    again = lease((300_000,), np.float32)
    assert again.ctypes.data == address


def test_idle_memory_is_bounded(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(memory, "MAX_IDLE", memory.idle_bytes() + (1 << 20))
    arrays = [lease((1 << 19,), np.uint8) for _ in range(10)]
    assert all(array.nbytes == 1 << 19 for array in arrays)
    arrays.clear()
    gc.collect()
    assert memory.idle_bytes() <= memory.MAX_IDLE


@pytest.mark.parametrize("size", [32_768, 32_769, 50_000, 123_456, 10_000_019])
def test_size_classes_waste_at_most_a_quarter(size: int) -> None:
    room = memory._size_class(size)
    assert size <= room <= 1.25 * size + 1
    assert memory._size_class(room) == room


@jit.inline
def _take(worker, counters, ends):
    return next_job(worker, counters, ends)


@jit.kernel
def _count_jobs(worker, counters, ends, done):
    while True:
        job = _take(worker, counters, ends)
        if job < 0:
            break
        done[job] += 1


@pytest.mark.parametrize("threads", [1, 2, 5])
@pytest.mark.parametrize("jobs", [0, 1, 3, 1000])
def test_every_job_is_done_once(jobs: int, threads: int) -> None:
    done = np.zeros(jobs, np.int64)
    run(_count_jobs, even_jobs(jobs, threads), done)
    assert (done == 1).all()


def test_one_thread_does_the_jobs_of_those_that_never_come() -> None:
    done, counters = np.zeros(10, np.int64), np.zeros(3 * SPACING, np.int64)
    _count_jobs(1, counters, even_jobs(10, 3), done)
    assert (done == 1).all()


@given(st.lists(st.integers(0, 100), min_size=1, max_size=30), st.integers(1, 6))
def test_weighted_shares_are_even_to_one_job(work: list[int], threads: int) -> None:
    before = np.concatenate(([0], np.cumsum(work)))
    ends = weighted_jobs(before, threads)
    assert len(ends) == threads + 1
    assert (ends[0], ends[-1]) == (0, len(work))
    assert (np.diff(ends) >= 0).all()
    assert np.diff(before[ends]).max() <= sum(work) / threads + max(work) + 1e-9


def test_failures_of_any_thread_are_raised() -> None:
    def fail(worker: int, counters: np.ndarray, ends: np.ndarray) -> None:
        if worker == 1:
            raise ValueError("no")

    for _ in range(20):  # a thread that comes too late is not run at all
        try:
            run(fail, even_jobs(3, 3))
        except ValueError:
            return
    pytest.fail("the failure was lost")


class OneThread(ThreadPoolExecutor):
    """A pool on a machine that starts one thread and no other."""

    def _adjust_thread_count(self) -> None:
        if self._threads:
            raise RuntimeError("can't start new thread")
        super()._adjust_thread_count()


def test_helpers_are_waited_for_where_a_thread_cannot_be_started(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """The pool's one thread goes on with the part that no thread was started for, and fails."""
    begun = threading.Event()

    def fail(worker: int, counters: np.ndarray, ends: np.ndarray) -> None:
        if worker == 0:
            assert begun.wait(60.0)
        if worker == 2:
            begun.set()
            time.sleep(0.05)  # the caller is done before
            raise ValueError("no")

    with OneThread(2) as pool:
        monkeypatch.setattr(memory, "_openmp", lambda: None)
        monkeypatch.setattr(memory, "_pool", lambda process, threads: pool)
        with pytest.raises(ValueError, match="no"):
            run(fail, even_jobs(3, 3))


def test_thread_count_follows_torch() -> None:
    before = torch.get_num_threads()
    try:
        torch.set_num_threads(5)
        assert [thread_count(jobs) for jobs in (0, 1, 4, 9)] == [1, 1, 4, 5]
        assert [thread_count(9, work) for work in (10, 10_000, 10**6)] == [1, 2, 5]
    finally:
        torch.set_num_threads(before)
