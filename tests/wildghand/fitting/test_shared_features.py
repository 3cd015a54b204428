"""Texture features shared by the steps of a block; oracle: gradients of the block's mean loss."""

from __future__ import annotations

from collections.abc import Mapping

import pytest
import torch
from torch import Tensor

from wildghand.fitting.descent import SharedFeatures
from wildghand.network import HandFeatures, PredictionNetwork, SurfacePoints, network_settings

COUNT, EVERY = 40, 3
SHARED = ("texture_branch", "template_head", "attribute_head.texture", "refinement_head.shape")


def network() -> PredictionNetwork:
    random = torch.Generator().manual_seed(0)
    points = SurfacePoints(
        uv=torch.rand(COUNT, 2, generator=random),
        positions=2.0 * torch.rand(COUNT, 3, generator=random) - 1.0,
        spacing=2e-3,
        color=torch.full((3,), 0.5),
    )
    settings = network_settings("compact", identity_resolution=16, plane_resolution=8)
    made = PredictionNetwork(settings, {"right": points}, seed=1)
    with torch.no_grad():
        for parameter in made.parameters():
            parameter.add_(0.1 * torch.randn(parameter.shape, generator=random))
    return made


def terms(features: Mapping[str, HandFeatures]) -> Tensor:
    """Terms that no frame enters."""
    return features["right"].template_offsets.square().sum() * 1e4


def loss_of(net: PredictionNetwork, features: Mapping[str, HandFeatures], frame: int) -> Tensor:
    random = torch.Generator().manual_seed(frame)
    normals = torch.nn.functional.normalize(torch.randn(1, COUNT, 3, generator=random), dim=-1)
    pose = 0.3 * torch.randn(1, 16, 3, generator=random)
    made = net("right", normals, pose, features["right"])
    weight = torch.randn(1, COUNT, 14, generator=random)
    change = made.refinement.pose.square().sum() + made.refinement.betas.square().sum()
    offsets = (made.template_offsets * weight[0, :, :3]).sum()
    return (made.raw.concatenate() * weight).mean() + made.shadow.mean() + change + offsets


def is_shared(name: str) -> bool:
    return name.startswith(SHARED)


def test_the_texture_branch_takes_the_mean_of_a_block_once() -> None:
    """Parameters stand still here, so that the block is one batch; float32, 1e-5."""
    net = network()
    shared = SharedFeatures(net, EVERY, terms)
    for frame in range(EVERY):
        net.zero_grad()
        features = shared.features()
        loss = loss_of(net, features, frame)
        waiting = shared.backward(loss, loss.detach())
        reached = {name for name, p in net.named_parameters() if p.grad is not None}
        assert any(is_shared(name) for name in reached) == (frame == EVERY - 1)
        assert any(not is_shared(name) for name in reached)
    found = {name: p.grad for name, p in net.named_parameters() if is_shared(name)}
    oracle = network()
    features = {"right": oracle.features("right")}
    losses = torch.stack([loss_of(oracle, features, frame) for frame in range(EVERY)])
    (losses.mean() + terms(features)).backward()
    torch.testing.assert_close(waiting, losses.sum().detach())
    for name, parameter in oracle.named_parameters():
        if is_shared(name):
            torch.testing.assert_close(found[name], parameter.grad, rtol=1e-4, atol=1e-6)


def test_a_block_of_one_step_is_the_plain_backward_pass() -> None:
    net, oracle = network(), network()
    shared = SharedFeatures(net, 1, terms)
    for frame in range(2):
        net.zero_grad()
        oracle.zero_grad()
        loss = loss_of(net, shared.features(), frame)
        shared.backward(loss, loss.detach())
        features = {"right": oracle.features("right")}
        (loss_of(oracle, features, frame) + terms(features)).backward()
        assert torch.equal(shared.value, terms(features).detach())
        for one, other in zip(net.parameters(), oracle.parameters(), strict=True):
            assert torch.equal(one.grad, other.grad)  # type: ignore[arg-type]


def steps(net: PredictionNetwork, shared: SharedFeatures, first: int, last: int) -> None:
    """Plain descent, which moves the identity map within blocks."""
    for frame in range(first, last):
        net.zero_grad()
        loss = loss_of(net, shared.features(), frame)
        shared.backward(loss, loss.detach())
        with torch.no_grad():
            for parameter in net.parameters():
                if parameter.grad is not None:
                    parameter -= 1e-2 * parameter.grad


@pytest.mark.parametrize("stop", [1, 2, 3, 4])
def test_a_fit_goes_on_within_a_block(stop: int) -> None:
    """Oracle: the same steps without a stop, bit for bit."""
    whole = network()
    steps(whole, SharedFeatures(whole, EVERY, terms), 0, 7)
    first = network()
    shared = SharedFeatures(first, EVERY, terms)
    steps(first, shared, 0, stop)
    saved = shared.state_dict()
    second = network()
    second.load_state_dict(first.state_dict())
    again = SharedFeatures(second, EVERY, terms)
    again.load_state_dict(saved)
    steps(second, again, stop, 7)
    for one, other in zip(whole.parameters(), second.parameters(), strict=True):
        assert torch.equal(one, other)


def test_a_loss_that_is_not_finite_is_seen_at_the_end_of_its_block() -> None:
    net = network()
    shared = SharedFeatures(net, EVERY, terms)
    found = []
    for frame in range(2 * EVERY):
        loss = loss_of(net, shared.features(), frame)
        loss = loss * torch.nan if frame == 1 else loss
        found.append(bool(shared.backward(loss, loss.detach()).isfinite()))
        net.zero_grad()
    assert found == [True, False, False, True, True, True]
