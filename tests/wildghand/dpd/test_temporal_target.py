"""Temporal weights and what the pre-pass found. Oracles: the targets, the formula written out."""

from __future__ import annotations

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from wildghand.dpd.dpd import DynamicPerturbation
from wildghand.dpd.temporal import TemporalTarget
from wildghand.gaussians.attributes import RawAttributes

SCALE, FLOOR = 0.5, 0.02


def judged(clean: torch.Tensor) -> TemporalTarget:
    return TemporalTarget.judged(FLOOR + (1.0 - FLOOR) * clean, SCALE, FLOOR)


def episodes(count: int = 48) -> torch.Tensor:
    """Probabilities that frames are clean: three episodes of different strength."""
    clean = torch.ones(count)
    for start, worst in ((0.1, 0.7), (0.4, 0.0), (0.75, 0.3)):
        first = int(start * count)
        clean[first : first + count // 8] = worst
    return clean


def module(count: int = 48, seed: int = 0) -> DynamicPerturbation:
    torch.manual_seed(seed)
    return DynamicPerturbation(count)


def attributes(*lead: int) -> RawAttributes:
    return RawAttributes.split(torch.randn(*lead, 14, generator=torch.Generator().manual_seed(0)))


def omega_of(learnt: DynamicPerturbation) -> torch.Tensor:
    return learnt.temporal(torch.arange(learnt.frame_count)).omega.detach()


@pytest.mark.parametrize("count", [48, 560])
def test_weights_begin_at_what_was_judged(count: int) -> None:
    clean, learnt = episodes(count), module(count)
    target = judged(clean)
    target.begin([learnt])
    error = (omega_of(learnt) - target.omega).square().mean().sqrt()
    # A tenth of the scale; episodes begin abruptly, which the code of a long clip cannot follow
    # as closely.
    assert error < (0.1 if count < 100 else 0.2) * SCALE


def test_the_factor_of_pao_is_what_the_prepass_found() -> None:
    """Oracle: the weights that were given."""
    clean = episodes()
    weights = FLOOR + (1.0 - FLOOR) * clean
    target = judged(clean)
    beta = (1.0 / FLOOR - 1.0) / SCALE
    torch.testing.assert_close(1.0 / (1.0 + beta * target.omega), weights)
    assert float(target.omega.max()) == pytest.approx(SCALE)
    # Weights of 0 are no division by 0.
    none = TemporalTarget.judged(torch.zeros(3), SCALE, 0.0)
    assert none.omega.isfinite().all()


def test_biases_begin_at_zero_and_learn_from_the_first_step() -> None:
    learnt = module()
    judged(episodes()).begin([learnt])
    frames = torch.arange(48)
    temporal = learnt.temporal(frames)
    biases = learnt.biases(attributes(48, 5), temporal.z, temporal.omega).concatenate()
    assert (biases == 0.0).all()
    assert all(parameter.grad is None for parameter in learnt.parameters())
    (biases - 1.0).square().mean().backward()
    assert all(value.grad.abs().max() > 0.0 for value in learnt.varphi.parameters())


def test_where_every_frame_is_clean_the_start_is_the_papers() -> None:
    learnt = module()
    judged(torch.ones(48)).begin([learnt])
    assert (omega_of(learnt) == 0.0).all()
    assert learnt.varphi["logit_colors"].weight.abs().max() > 0.0


def test_the_start_repeats_exactly() -> None:
    first, second = module(), module()
    for learnt in (first, second):
        judged(episodes()).begin([learnt])
    assert torch.equal(omega_of(first), omega_of(second))


def test_distance_is_the_square_summed_over_hands() -> None:
    left, right = module(10, 1), module(10, 2)
    for learnt in (left, right):
        torch.nn.init.normal_(learnt.psi.weight)
    target = TemporalTarget(torch.linspace(0.0, 0.5, 10))
    expected = sum(((omega_of(learnt) - target.omega) ** 2).mean() for learnt in (left, right))
    torch.testing.assert_close(target.temporal_loss([left, right], 3).detach(), expected)


def test_gradient_of_the_distance_is_that_of_the_formula() -> None:
    """Oracle: autograd on the formula as written; float64, to 1e-9."""
    torch.manual_seed(3)
    learnt = module(10).double()
    torch.nn.init.normal_(learnt.psi.weight)
    target = TemporalTarget(torch.linspace(0.0, 0.5, 10).double())
    weights = [*learnt.phi.parameters(), *learnt.psi.parameters()]
    found = torch.autograd.grad(3.0 * target.temporal_loss([learnt], 3), weights)
    omega = learnt.temporal(torch.arange(10)).omega
    distance = ((omega - target.omega) ** 2).mean()
    expected = torch.autograd.grad(3.0 * distance, weights)
    torch.testing.assert_close(found, expected, atol=1e-9, rtol=1e-9)


def test_every_frame_of_a_long_clip_is_looked_at_by_some_step() -> None:
    count = 300
    learnt = module(count)
    for frame in range(0, count, 7):
        omega = torch.zeros(count)
        omega[frame] = 0.5
        target = TemporalTarget(omega)
        # Omega is zero everywhere, so that the one frame is all of the distance.
        seen = [first for first in range(count) if target.temporal_loss([learnt], first) > 0.0]
        assert frame in seen
        assert len(seen) >= count // 64


def test_holding_keeps_the_weights_and_letting_go_does_not() -> None:
    """A pull on all weights, as a fit that explains frames by larger biases would make it."""
    errors = []
    target = judged(episodes())
    for weight in (0.0, 100.0):
        learnt = module()
        target.begin([learnt])
        optimizer = torch.optim.Adam(learnt.parameters(), lr=1e-3)
        for step in range(60):
            loss = -learnt.temporal(torch.tensor([step % 48])).omega.mean()
            loss = loss + weight * target.temporal_loss([learnt], step % 48)
            optimizer.zero_grad()
            loss.backward()
            optimizer.step()
        errors.append(float((omega_of(learnt) - target.omega).abs().mean()))
    assert errors[1] < 0.2 * errors[0]


@settings(max_examples=15, deadline=None)
@given(clean=st.lists(st.floats(0.0, 1.0, width=32), min_size=1, max_size=12))
def test_any_judgement_gives_weights_in_range(clean: list[float]) -> None:
    learnt = module(len(clean))
    target = judged(torch.tensor(clean))
    target.begin([learnt])
    omega = omega_of(learnt)
    assert omega.isfinite().all()
    assert (omega.abs() < 0.9).all()
    assert target.temporal_loss([learnt], 0).isfinite()
