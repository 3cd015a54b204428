"""The number of threads that steps run on. Oracles: a stopped clock; fits on one thread."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import pytest
import torch
from stopped_clock import stop_clock
from tiny_fits import UNJUDGED

from hwp_bench.methods.contract import Budget
from wildghand.fitting.components import make_fit
from wildghand.gaussians import fit_loop as step_threads
from wildghand.gaussians.fit_loop import BLOCK, HELD, TURNS, StepThreads, candidates, fewest
from wildghand.model.settings import read_settings
from wildghand.plain.loop import run_fit
from wildghand.splat import threads

CPU = torch.device("cpu")


class Silent:
    elapsed = 0.0

    def __call__(self, step: int, avatar: object) -> None:
        pass

    def progress(self, done: int, total: int) -> None:
        pass


def test_numbers_that_are_compared() -> None:
    assert [candidates(most) for most in (1, 2, 3, 4, 6)] == [
        (1,),
        (1, 2),
        (1, 2, 3),
        (1, 2, 4),
        (1, 2, 4, 6),
    ]


def test_more_threads_must_gain_a_tenth() -> None:
    assert fewest({1: 1.0, 2: 0.95}) == 1
    assert fewest({1: 1.0, 2: 0.8, 4: 0.75}) == 2
    assert fewest({1: 1.0, 2: 0.8, 4: 0.5}) == 4
    assert fewest({1: 1.0, 2: 9.0}) == 1


def test_the_choice_follows_the_load(monkeypatch: pytest.MonkeyPatch) -> None:
    """Idle, four threads take half the time; later, beside others, ten times as long."""
    clock = stop_clock(monkeypatch, step_threads.__name__)
    choice, used = StepThreads((1, 2, 4)), []
    seconds = {1: 1.0, 2: 0.7, 4: 0.5}

    def take(blocks: int) -> list[int | None]:
        used.clear()
        for _ in range(blocks * BLOCK):
            with choice.step():
                used.append(threads._MOST.get())
                clock.now += seconds[used[-1]]
        return used[::BLOCK]

    assert take(1) == [4]  # the first block is warm-up
    assert take(3 * TURNS) == [1, 2, 4] * TURNS
    assert set(take(HELD)) == {4}
    seconds |= {2: 5.0, 4: 10.0}
    assert take(3 * TURNS) == [1, 2, 4] * TURNS
    assert set(take(HELD)) == {1}
    assert threads._MOST.get() is None


def test_nothing_is_chosen_where_somebody_has_said_it(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("OMP_NUM_THREADS", raising=False)
    monkeypatch.delenv("MKL_NUM_THREADS", raising=False)
    monkeypatch.setattr(torch, "get_num_threads", lambda: 4)
    assert StepThreads.of(CPU).number == 4
    assert StepThreads.of(torch.device("cuda")).number is None
    for name in ("OMP_NUM_THREADS", "MKL_NUM_THREADS"):
        with monkeypatch.context() as context:
            context.setenv(name, "3")
            choice = StepThreads.of(CPU)
            for _ in range(3 * BLOCK):
                with choice.step():
                    assert choice.number is None
                    assert threads.thread_count(100) == 4


def test_kernels_take_fewer_threads_and_torch_keeps_its_own(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(torch, "get_num_threads", lambda: 4)
    assert threads.thread_count(100) == 4
    with threads.at_most(2):
        assert threads.thread_count(100) == 2
        assert threads.thread_count(100, threads.WORTH_A_THREAD) == 1
        with threads.at_most(None):
            assert threads.thread_count(100) == 4
        assert torch.get_num_threads() == 4
    assert threads.thread_count(100) == 4


def test_a_fit_has_the_same_bits_whatever_was_chosen(
    make_training: Callable[..., Any], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Every step on another number of threads, three among them, against one thread."""
    monkeypatch.setattr(threads, "WORTH_A_THREAD", 1)
    settings = read_settings({**UNJUDGED, "schedule.batch": 2})
    before, used = torch.get_num_threads(), set()

    class Changing(StepThreads):
        def __init__(self, numbers: tuple[int, ...]) -> None:
            super().__init__()
            self._turns = numbers
            self._taken = 0

        def step(self) -> Any:
            number = self._turns[self._taken % len(self._turns)]
            self._taken += 1
            used.add(number)
            return threads.at_most(number)

    def fitted(*numbers: int) -> dict[str, torch.Tensor]:
        fit = make_fit(make_training(), settings, 0, CPU)
        run_fit(fit, Budget(steps=3), Silent(), threads=Changing(numbers))
        return fit.model.snapshot()

    try:
        torch.set_num_threads(3)
        alone = fitted(1)
        other = fitted(3, 2, 1)
        assert all(torch.equal(alone[name], other[name]) for name in alone)
    finally:
        torch.set_num_threads(before)
    assert used == {1, 2, 3}
