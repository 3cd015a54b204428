"""Values and gradients of `compact` in float32; oracle: the same in float64; 1e-5."""

from __future__ import annotations

import copy

import pytest
import torch
from torch import Tensor

from wildghand.network import (
    NetworkOutput,
    PredictionNetwork,
    SurfacePoints,
    network_settings,
)

COUNT = 700
COLOR = torch.tensor([0.6, 0.45, 0.4])


def made(direct: bool, degree: int, layers: int = 1, **widths: int) -> PredictionNetwork:
    """A network away from its start."""
    random = torch.Generator().manual_seed(0)
    points = SurfacePoints(
        uv=torch.rand(COUNT, 2, generator=random),
        positions=2.0 * torch.rand(COUNT, 3, generator=random) - 1.0,
        spacing=2e-3,
        color=COLOR,
    )
    settings = network_settings(
        "compact",
        identity_resolution=24,
        plane_resolution=12,
        direct=direct,
        shading_degree=degree,
        head_layers=layers,
        **widths,
    )
    network = PredictionNetwork(settings, {"right": points}, seed=1)
    with torch.no_grad():
        for parameter in network.parameters():
            parameter.add_(0.1 * torch.randn(parameter.shape, generator=random))
    return network


def inputs(batch: int) -> tuple[Tensor, Tensor]:
    random = torch.Generator().manual_seed(2)
    normals = torch.randn(batch, COUNT, 3, generator=random)
    pose = 0.4 * torch.randn(batch, 16, 3, generator=random)
    return torch.nn.functional.normalize(normals, dim=-1), pose


def parts(output: NetworkOutput) -> list[Tensor]:
    refinement = output.refinement
    return [
        output.raw.concatenate(),
        output.shadow,
        output.template_offsets,
        refinement.pose,
        refinement.betas,
        refinement.transl,
    ]


def gradients(network: PredictionNetwork, normals: Tensor, pose: Tensor) -> dict[str, Tensor]:
    """Of a random combination of everything that is predicted."""
    random = torch.Generator().manual_seed(3)
    network.zero_grad()
    total = torch.zeros((), dtype=normals.dtype)
    for part in parts(network("right", normals, pose)):
        total = total + (part * torch.randn(part.shape, generator=random).to(part)).sum()
    total.backward()
    found = {name: p.grad for name, p in network.named_parameters()}
    assert all(gradient is not None for gradient in found.values())
    return {name: gradient.clone() for name, gradient in found.items() if gradient is not None}


@pytest.mark.parametrize(("direct", "degree", "batch"), [(True, 3, 1), (True, 2, 3), (False, 1, 2)])
def test_float32_is_as_float64(direct: bool, degree: int, batch: int) -> None:
    network = made(direct, degree)
    normals, pose = inputs(batch)
    exact = copy.deepcopy(network).double()
    values, slopes = parts(network("right", normals, pose)), gradients(network, normals, pose)
    true_values = parts(exact("right", normals.double(), pose.double()))
    true_slopes = gradients(exact, normals.double(), pose.double())
    for value, true in zip(values, true_values, strict=True):
        torch.testing.assert_close(value.double(), true, rtol=1e-5, atol=1e-5)
    for name, true in true_slopes.items():
        scale = float(true.abs().max())
        torch.testing.assert_close(slopes[name].double() / scale, true / scale, rtol=0, atol=1e-5)


def test_the_number_of_threads_changes_rounding_only_and_a_call_repeats_exactly() -> None:
    network = made(True, 3)
    normals, pose = inputs(2)
    before = torch.get_num_threads()
    try:
        torch.set_num_threads(2)
        first, again = (gradients(network, normals, pose) for _ in range(2))
    finally:
        torch.set_num_threads(before)
    assert all(torch.equal(first[name], again[name]) for name in first)
