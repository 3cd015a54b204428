"""Denormals within a library's functions and after them. Oracle: a product that is denormal."""

from __future__ import annotations

import sys
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
import torch
from tiny_fits import UNJUDGED

from hwp_bench.base.numerics import flushed, flushes
from hwp_bench.methods.contract import Budget
from wildghand.fitting.method import WildGHandMethod
from wildghand.splat import threads
from wildghand.splat.threads import denormals_flushed, even_jobs, run

THREADS = 3


@pytest.fixture(autouse=True)
def several_threads() -> Any:
    before = torch.get_num_threads()
    torch.set_num_threads(THREADS)
    yield
    torch.set_num_threads(before)


def denormal_products() -> int:
    """How many of a million products that torch's threads compute are denormal, not zero."""
    values = torch.full((1_000_000,), sys.float_info.min, dtype=torch.float64)
    return int((values * 0.5).count_nonzero())


def test_torch_s_team_flushes_meanwhile_and_no_longer_afterwards() -> None:
    assert denormal_products() == 1_000_000  # and the team's threads have started
    with denormals_flushed():
        assert denormal_products() == 0
        with denormals_flushed():
            assert denormal_products() == 0
        assert denormal_products() == 0
    assert denormal_products() == 1_000_000


def test_a_team_that_has_grown_meanwhile_goes_back_too() -> None:
    torch.set_num_threads(2)
    denormal_products()
    with denormals_flushed():
        torch.set_num_threads(THREADS)
        assert denormal_products() == 0
    assert denormal_products() == 1_000_000


@pytest.mark.parametrize("crowded", [False, True], ids=["torch's threads", "plain threads"])
def test_threads_of_kernels_do_as_their_caller(
    crowded: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(threads, "_crowded", lambda second: crowded)
    found = np.zeros(THREADS, bool)

    def kernel(worker: int, counters: np.ndarray, ends: np.ndarray) -> None:
        found[worker] = flushes()

    for _ in range(2):
        with flushed():
            run(kernel, even_jobs(THREADS, THREADS))
        assert found[0]
        # A helper that had not begun when the others were done is not needed.
        assert found.all() or crowded
        found[:] = True
        run(kernel, even_jobs(THREADS, THREADS))
        assert not found[0]
        assert crowded or not found.any()


def test_a_fit_flushes_and_gives_the_switch_back(make_training: Callable[..., Any]) -> None:
    training = make_training("right")
    found: list[bool] = []

    class Asked:
        elapsed = 0.0

        def __call__(self, step: int, avatar: Any) -> None:
            found.append(flushes())
            found.append(denormal_products() == 0)

        def progress(self, done: int, total: int) -> None:
            pass

    method = WildGHandMethod(UNJUDGED, 0)
    avatar = method.fit(training, Budget(steps=2), Asked())
    assert found == [True] * 6
    assert not flushes()
    assert denormal_products() == 1_000_000
    frame = int(training.train[0])
    avatar.render(training.hand_poses(frame), training.camera(frame))
    assert not flushes()
    assert denormal_products() == 1_000_000
