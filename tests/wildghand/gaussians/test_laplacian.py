"""Surface Laplacian. Oracles: brute-force neighbours in numpy; gradcheck; geometry of a hand."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from hwp_bench.base.errors import ShapeMismatch
from hwp_bench.hands import load_template
from hwp_bench.hands.anchors import anchor_positions
from wildghand.gaussians.attributes import RawAttributes
from wildghand.gaussians.regularizers import (
    SurfaceLaplacian,
    attribute_roughness,
    nearest_on_surface,
    surface_laplacian,
)
from wildghand.gaussians.rig import HandRig, make_rig


@pytest.fixture(scope="module")
def rig() -> HandRig:
    return make_rig(load_template(), 400)


@pytest.fixture(scope="module")
def laplacian(rig: HandRig) -> SurfaceLaplacian:
    return surface_laplacian(rig, dtype=torch.float64)


def test_neighbours_are_the_nearest_that_face_the_same_way() -> None:
    random = np.random.default_rng(0)
    positions = random.normal(size=(40, 3))
    normals = np.where(random.uniform(size=(40, 1)) < 0.7, 1.0, -1.0) * np.array([[0.0, 0.0, 1.0]])
    near = nearest_on_surface(positions, normals, 3)
    for i in range(40):
        distance = np.linalg.norm(positions - positions[i], axis=1)
        distance[i] = np.inf
        candidates = np.argsort(distance)[:9]
        agreeing = [int(j) for j in candidates if normals[j] @ normals[i] > 0.0][:3]
        assert [int(j) for j in near[i] if j >= 0] == agreeing


def test_constant_fields_are_smooth_and_single_spikes_are_not(laplacian: SurfaceLaplacian) -> None:
    constant = torch.ones(400, 3, dtype=torch.float64)
    assert laplacian(constant).abs().max() < 1e-12
    spike = constant.clone()
    spike[17] += 1.0
    assert laplacian(spike)[17].tolist() == pytest.approx([1.0] * 3)


def test_a_shift_of_the_whole_hand_is_smooth_in_its_own_frames(
    rig: HandRig, laplacian: SurfaceLaplacian
) -> None:
    shift = torch.tensor([1e-3, -2e-3, 5e-4])
    offsets = (rig_frames(laplacian).mT @ shift).double()
    assert float(laplacian.offsets(offsets)) < 1e-8
    # The same numbers in every anchor's frame are no shift.
    assert float(laplacian.offsets(shift.double().expand(400, 3))) > 1e-3
    assert rig.spacing == laplacian.spacing


def rig_frames(laplacian: SurfaceLaplacian) -> torch.Tensor:
    return laplacian.frames


def test_neighbours_are_close_on_a_hand(rig: HandRig, laplacian: SurfaceLaplacian) -> None:
    positions = anchor_positions(rig.template.vertices, rig.template.faces, rig.anchors)
    dense = laplacian.matrix.to_dense()
    rows, columns = np.nonzero((dense < 0.0).numpy())
    distance = (positions[rows] - positions[columns]).norm(dim=-1)
    assert float(distance.median()) < 1.5 * rig.spacing


def test_gradients_in_both_types_with_and_without_frames(
    rig: HandRig, laplacian: SurfaceLaplacian
) -> None:
    values = torch.randn(2, 400, 3, dtype=torch.float64, generator=torch.Generator().manual_seed(0))
    dense = laplacian.matrix.to_dense()
    single = surface_laplacian(rig)
    for shape in ((400, 3), (2, 400, 3)):
        part = values.reshape(-1, 3)[: np.prod(shape) // 3].reshape(shape).requires_grad_(True)
        torch.testing.assert_close(laplacian(part), dense @ part)
        small = part.detach().float().requires_grad_(True)
        for exact, rounded in (
            (laplacian.roughness(part), single.roughness(small)),
            (laplacian.offsets(1e-3 * part), single.offsets(1e-3 * small)),
        ):
            double = torch.autograd.grad(exact, part)[0]
            assert (torch.autograd.grad(rounded, small)[0] - double).norm() < 1e-4 * double.norm()
        by_hand = 2.0 * dense.T @ (dense @ part) / (part.numel() / 3)
        torch.testing.assert_close(
            torch.autograd.grad(laplacian.roughness(part), part)[0], by_hand.detach()
        )


@pytest.mark.parametrize("count", [1, 2, 5])
def test_few_anchors_work(count: int) -> None:
    made = surface_laplacian(make_rig(load_template(), count))
    values = torch.randn(count, 3, requires_grad=True)
    made.roughness(values).backward()
    assert values.grad.isfinite().all()
    with pytest.raises(ShapeMismatch, match="values"):
        made(torch.zeros(count + 1, 3))


@pytest.mark.parametrize("frames", [1, 3])
@pytest.mark.parametrize(("scales", "colors"), [(0.3, 2.0), (0.0, 1.0)])
def test_roughness_of_attributes_is_that_of_its_parts_in_float64(
    rig: HandRig, laplacian: SurfaceLaplacian, frames: int, scales: float, colors: float
) -> None:
    random = torch.Generator().manual_seed(0)
    raw = torch.randn(frames, 400, 14, generator=random).requires_grad_()
    value = attribute_roughness(surface_laplacian(rig), RawAttributes.split(raw), scales, colors)
    (gradient,) = torch.autograd.grad(3.0 * value, raw)
    true = raw.detach().double()
    parts = RawAttributes.split(true.requires_grad_())
    oracle = scales * laplacian.roughness(parts.log_scales)
    oracle = oracle + colors * laplacian.roughness(parts.logit_colors.sigmoid())
    (expected,) = torch.autograd.grad(3.0 * oracle, true)
    torch.testing.assert_close(value.double(), oracle, rtol=1e-5, atol=0)
    scale = float(expected.abs().max())
    torch.testing.assert_close(gradient.double() / scale, expected / scale, rtol=0, atol=1e-5)
