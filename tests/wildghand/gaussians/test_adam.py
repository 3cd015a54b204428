"""A step of the optimizer. Oracle: `torch.optim.Adam` behind torch's own clipping, to 1e-6."""

from __future__ import annotations

import copy
import math

import pytest
import torch

from wildghand.gaussians.adam import ClippedAdam

#: Vectors, a scalar, a channels-last weight, and a long one.
SHAPES = [(3,), (), (16, 5), (1,), (7, 33), (4, 4, 3, 3), (32_773,), (9, 16)]
STEPS = 6


def parameters() -> list[torch.Tensor]:
    generator = torch.Generator().manual_seed(0)
    made = [torch.randn(shape, generator=generator) for shape in SHAPES]
    made[5] = made[5].contiguous(memory_format=torch.channels_last)
    return [tensor.requires_grad_() for tensor in made]


def give_gradients(
    tensors: list[torch.Tensor], step: int, size: float = 1.0, *, alike: bool = False
) -> None:
    """Half of the rows never get one, the last tensor not in every step.

    `alike`: they lie in memory as the parameters do, which torch's fused step takes for granted.
    """
    generator = torch.Generator().manual_seed(100 + step)
    for tensor in tensors:
        gradient = size * torch.randn(tensor.shape, generator=generator)
        if tensor.ndim == 2:
            gradient[::2] = 0.0
        tensor.grad = torch.empty_like(tensor).copy_(gradient) if alike else gradient
    if step % 3 == 1:
        tensors[-1].grad = None


def groups(tensors: list[torch.Tensor]) -> list[dict]:
    return [
        {"params": tensors[:3], "lr": 0.03},
        {"params": tensors[3:5], "lr": 1e-4, "clipped": False},
        {"params": tensors[5:], "lr": 0.01},
    ]


def torch_adam(tensors: list[torch.Tensor]) -> torch.optim.Adam:
    return torch.optim.Adam(groups(tensors), eps=1e-15, betas=(0.9, 0.99), fused=True)


def largest_difference(first: list[torch.Tensor], second: list[torch.Tensor]) -> float:
    return max(float((a - b).detach().abs().max()) for a, b in zip(first, second, strict=True))


@pytest.mark.parametrize("limit", [0.0, 0.5])
@pytest.mark.parametrize("size", [1e-6, 1.0])
def test_steps_are_those_of_torch(limit: float, size: float) -> None:
    ours, theirs = parameters(), parameters()
    mine, other = ClippedAdam(groups(ours), limit), torch_adam(theirs)
    for step in range(STEPS):
        give_gradients(ours, step, size)
        give_gradients(theirs, step, size, alike=True)
        mine.take_step(torch.zeros(()))
        if limit:
            torch.nn.utils.clip_grad_norm_([*theirs[:3], *theirs[5:]], limit)
        other.step()
    assert largest_difference(ours, theirs) < 1e-6


def test_a_state_that_torch_saved_goes_on() -> None:
    ours, theirs = parameters(), parameters()
    other = torch_adam(theirs)
    for step in range(3):
        give_gradients(theirs, step, alike=True)
        other.step()
    for tensor, value in zip(ours, theirs, strict=True):
        tensor.data = value.detach().clone()
    mine = ClippedAdam(groups(ours), 0.0)
    mine.load_state_dict(copy.deepcopy(other.state_dict()))
    assert [group.get("clipped", True) for group in mine.param_groups] == [True, False, True]
    for step in range(3, STEPS):
        give_gradients(ours, step)
        give_gradients(theirs, step, alike=True)
        mine.take_step(torch.zeros(()))
        other.step()
    assert largest_difference(ours, theirs) < 1e-6
    saved, expected = mine.state_dict()["state"], other.state_dict()["state"]
    assert saved.keys() == expected.keys()
    for number, state in expected.items():
        for name, value in state.items():
            torch.testing.assert_close(saved[number][name], value)


@pytest.mark.parametrize("bad", [math.nan, math.inf, -math.inf])
@pytest.mark.parametrize("clipped", [True, False])
def test_a_gradient_that_is_no_number_skips_the_step(bad: float, clipped: bool) -> None:
    tensors = parameters()
    optimizer = ClippedAdam(groups(tensors), 1.0)
    place = next(
        group["params"][0]
        for group in optimizer.param_groups
        if group.get("clipped", True) == clipped
    )
    loss = torch.zeros(())
    give_gradients(tensors, 0)
    optimizer.take_step(loss)
    before = [tensor.detach().clone() for tensor in tensors]
    give_gradients(tensors, 1)
    assert place.grad is not None
    place.grad.view(-1)[-1] = bad
    optimizer.take_step(loss)
    assert all(torch.equal(a, b) for a, b in zip(tensors, before, strict=True))
    assert float(optimizer.state[tensors[0]]["step"]) == 1.0
    give_gradients(tensors, 2)
    optimizer.take_step(loss)
    assert largest_difference(tensors, before) > 1e-3


@pytest.mark.parametrize("loss", [math.nan, math.inf])
def test_a_loss_that_is_no_number_changes_nothing(loss: float) -> None:
    tensors = parameters()
    before = [tensor.detach().clone() for tensor in tensors]
    optimizer = ClippedAdam(groups(tensors), 1.0)
    give_gradients(tensors, 0)
    optimizer.take_step(torch.tensor(loss))
    assert all(torch.equal(a, b) for a, b in zip(tensors, before, strict=True))
    assert float(optimizer.state[tensors[0]]["step"]) == 0.0
    give_gradients(tensors, 0)
    optimizer.take_step(torch.tensor(1.0))
    assert largest_difference(tensors, before) > 1e-3


def test_gradients_are_dropped() -> None:
    tensors = parameters()
    give_gradients(tensors, 0)
    ClippedAdam(groups(tensors), 1.0).clear()
    assert all(tensor.grad is None for tensor in tensors)
