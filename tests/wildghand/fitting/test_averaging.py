"""The mean of the last steps.

Oracles: weights of Shamir and Zhang's polynomial-decay averaging, multiplied out in float64; the
fit that takes every step by hand; a checkpoint against the avatar of a fit that ends there.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from odd_fits import part
from painted import SilentReport, TrainingMaker
from tiny_fits import QUICK

from hwp_bench.methods.contract import Avatar, Budget
from wildghand.fitting.choice import AveragedSteps
from wildghand.fitting.components import make_fit
from wildghand.gaussians.fit_loop import batches, repeatable
from wildghand.model.settings import read_settings
from wildghand.plain.choice import AveragedAvatar, Averaging
from wildghand.plain.loop import run_fit

FIT: dict[str, Any] = {**QUICK, "schedule.steps": 24}
CPU = torch.device("cpu")


def weights_of(steps: int, share: float) -> np.ndarray:
    """(steps,) weight of each step: mean' = (1 - w) mean + w now, w = (eta + 1) / (t + eta)."""
    eta, weights = 1.0 / share - 1.0, np.zeros(steps)
    for t in range(1, steps + 1):
        now = (eta + 1.0) / (t + eta)
        weights *= 1.0 - now
        weights[t - 1] = now
    return weights


def averaged(steps: int, share: float) -> np.ndarray:
    """(steps,) weights that the average gives: tensor t is one at its place."""
    tensor = torch.zeros(steps, dtype=torch.float64)
    average = Averaging([tensor], share)
    for t in range(steps):
        tensor.zero_()[t] = 1.0
        average.take()
    average.put()
    return tensor.numpy()


@given(steps=st.integers(1, 60), share=st.floats(0.01, 1.0))
def test_weights_are_those_of_polynomial_decay(steps: int, share: float) -> None:
    found = averaged(steps, share)
    np.testing.assert_allclose(found, weights_of(steps, share), rtol=1e-9, atol=1e-15)
    assert found.sum() == pytest.approx(1.0, rel=1e-9)


def test_a_whole_share_is_the_plain_mean_and_none_is_the_last_step() -> None:
    np.testing.assert_allclose(averaged(8, 1.0), np.full(8, 1 / 8), rtol=1e-12)
    assert averaged(8, 0.0).tolist() == [0.0] * 7 + [1.0]


def test_a_tenth_counts_most_of_the_last_tenth_whenever_it_ends() -> None:
    for steps in (100, 1000):
        found = averaged(steps, 0.1)
        # 1 - 0.9 ** 10 = 0.65 of the weight, and half as much again from the tenth before.
        assert found[-steps // 10 :].sum() == pytest.approx(0.65, abs=0.02)
        assert found[-steps // 5 :].sum() == pytest.approx(0.89, abs=0.02)


def test_in_place_gives_every_bit_back() -> None:
    tensor = torch.arange(5.0)
    average = Averaging([tensor], 0.5)
    for _ in range(3):
        tensor.mul_(1.1)
        average.take()
    before = tensor.clone()
    with pytest.raises(KeyError), average.in_place():
        assert not torch.equal(tensor, before)
        raise KeyError
    assert torch.equal(tensor, before)
    average.forget()
    average.put()
    assert torch.equal(tensor, before)


@pytest.mark.parametrize("share", [0.0, 0.1, 1.0])
def test_a_fit_ends_with_the_mean_of_its_steps(share: float, make_training: TrainingMaker) -> None:
    settings = read_settings({**FIT, "schedule.average_share": share})
    training = make_training()
    avatar = run_fit(make_fit(training, settings, 0, CPU), Budget(), SilentReport())
    fit, steps = make_fit(training, settings, 0, CPU), settings.schedule.steps
    order = batches(len(fit.data.frames), 1, 0)
    states = []
    with repeatable(CPU):
        for step in range(steps):
            fit.step(next(order), step / steps)
            states.append({n: p.detach().clone() for n, p in fit.model.named_parameters()})
    weights = weights_of(steps, share) if share else np.eye(steps)[-1]
    for name, found in avatar.model.named_parameters():
        values = torch.stack([state[name] for state in states]).double()
        expected = torch.tensordot(torch.from_numpy(weights), values, dims=1)
        # float32, rounded at each of the steps.
        torch.testing.assert_close(found.detach().double(), expected, rtol=1e-5, atol=1e-6)


def test_a_checkpoint_is_drawn_as_a_fit_that_ends_there(make_training: TrainingMaker) -> None:
    training, drawn = make_training(), {}
    # What comes after the last step (light, strength of the visibility) is not in a checkpoint.
    changes = {**FIT, "light.enabled": False, "visibility.enabled": False}

    class Drawing(SilentReport):
        def __call__(self, step: int, avatar: Avatar) -> None:
            if step in (0, 10):
                drawn[step] = avatar.render(training.hand_poses(0), training.camera(0))
                assert isinstance(avatar, AveragedAvatar)
                assert avatar.device == "cpu"

    settings = read_settings(changes)
    watched = run_fit(make_fit(training, settings, 0, CPU), Budget(), Drawing())
    alone = run_fit(make_fit(training, settings, 0, CPU), Budget(), SilentReport())
    for name, value in alone.model.snapshot().items():
        assert torch.equal(watched.model.snapshot()[name], value)
    # The same rates as of a fit of 24 steps, of which ten are taken.
    fit, order = make_fit(training, settings, 0, CPU), batches(len(watched.record.frames), 1, 0)
    with repeatable(CPU):
        for step in range(10):
            fit.step(next(order), step / 24)
            part(fit, AveragedSteps).take()
    part(fit, AveragedSteps).put()
    ended = fit.avatar(10).render(training.hand_poses(0), training.camera(0))
    np.testing.assert_array_equal(drawn[10], ended)
    assert np.abs(drawn[0] - ended).max() > 0.05
