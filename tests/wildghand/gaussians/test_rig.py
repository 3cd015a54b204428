"""The rig. Oracle: `pose_hand`, the surface anchors themselves and autograd, in float64."""

from __future__ import annotations

import dataclasses
import math
import tracemalloc

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch import Tensor

from hwp_bench.hands import HandTemplate, SurfaceAnchors, TemplateTensors, load_template, pose_hand
from hwp_bench.hands.anchors import anchor_frames, anchor_positions
from wildghand.gaussians.quaternions import matrix_to_quat
from wildghand.gaussians.rig import CHUNK, FollowCpu, HandRig, make_rig


@pytest.fixture(scope="module")
def template() -> HandTemplate:
    return load_template()


def parameters(frames: int, seed: int = 0) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    random = torch.Generator().manual_seed(seed)
    return (
        0.3 * torch.randn(frames, 16, 3, generator=random),
        torch.randn(10, generator=random),
        torch.randn(frames, 3, generator=random),
    )


def test_long_clips_are_posed_in_parts(template: HandTemplate) -> None:
    rig = make_rig(template, 20)
    pose, betas, transl = parameters(CHUNK + 2)
    together = rig.pose(pose, betas, transl)
    alone = rig.pose(pose[-1:], betas, transl[-1:])
    assert together.positions.shape == (CHUNK + 2, 20, 3)
    np.testing.assert_allclose(together.positions[-1], alone.positions[0], atol=1e-6)


def test_a_long_clip_takes_the_memory_of_its_result_and_one_part(template: HandTemplate) -> None:
    """What numpy allocates beyond the result, which is torch's, does not grow with the clip."""
    rig, peaks = make_rig(template, 3000), []
    for frames in (CHUNK, 2 * CHUNK, 8 * CHUNK):
        clip = parameters(frames)
        tracemalloc.start()
        rig.pose(*clip)
        peaks.append(tracemalloc.get_traced_memory()[1])
        tracemalloc.stop()
    assert peaks[2] < 1.1 * peaks[1]


def test_spacing_is_that_of_a_square_grid_of_equal_area(template: HandTemplate) -> None:
    corners = template.vertices[template.faces]
    cross = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    area = 0.5 * np.linalg.norm(cross, axis=1).sum()
    rig = make_rig(template, 400)
    assert rig.spacing**2 * len(rig) == pytest.approx(area, rel=1e-5)


def rig(correctives: bool) -> HandRig:
    """A hand of few anchors, with or without MANO's correctives of the pose."""
    made = make_rig(load_template(), 300, seed=3)
    if not correctives:
        return made
    random = torch.Generator().manual_seed(1)
    shape = (*made.template.vertices.shape, 135)
    basis = 1e-3 * torch.randn(shape, generator=random)
    return dataclasses.replace(made, template=dataclasses.replace(made.template, pose_basis=basis))


def exact(hand: HandRig) -> tuple[TemplateTensors, SurfaceAnchors]:
    """The same in float64."""
    tensors = {
        field.name: getattr(hand.template, field.name)
        for field in dataclasses.fields(hand.template)
    }
    changed = {
        name: tensor.double()
        for name, tensor in tensors.items()
        if tensor is not None and tensor.is_floating_point()
    }
    anchors = SurfaceAnchors(
        hand.anchors.face_index, torch.as_tensor(hand.anchors.barycentric).double()
    )
    return dataclasses.replace(hand.template, **changed), anchors


def given_parameters(frames: int, shapes: bool, seed: int = 0) -> list[Tensor]:
    random = torch.Generator().manual_seed(seed)
    pose = 0.4 * torch.randn(frames, 16, 3, generator=random)
    pose[0, 2] = 0.0
    pose[0, 3] *= 1e-4
    pose[0, 0] = torch.tensor([math.pi - 1e-3, 0.0, 0.0])
    betas = torch.randn(*((frames,) if shapes else ()), 10, generator=random)
    return [pose, betas, torch.randn(frames, 3, generator=random)]


@pytest.mark.parametrize("correctives", [False, True])
@pytest.mark.parametrize("shapes", [False, True])
def test_positions_frames_and_gradients(correctives: bool, shapes: bool) -> None:
    """1e-6 m; 1e-4 of a quaternion's entries; gradients 1e-5 of the largest."""
    hand = rig(correctives)
    mine = [value.requires_grad_() for value in given_parameters(2, shapes)]
    true = [value.detach().double().requires_grad_() for value in mine]
    posed = hand.follow(*mine)
    assert posed.positions.grad_fn is not None
    assert posed.positions.grad_fn.name().startswith(FollowCpu.__name__)
    template, anchors = exact(hand)
    vertices = pose_hand(template, *true).vertices
    positions = anchor_positions(vertices, template.faces, anchors)
    frames = matrix_to_quat(anchor_frames(vertices, template.faces, anchors))
    torch.testing.assert_close(posed.positions.double(), positions, rtol=0, atol=1e-6)
    assert not posed.orientations.requires_grad
    # Where two entries are equally large either may be the positive one.
    sign = torch.sign((posed.orientations * frames).sum(dim=-1, keepdim=True))
    torch.testing.assert_close(posed.orientations.double() * sign, frames, rtol=0, atol=1e-4)
    weight = torch.randn(positions.shape, generator=torch.Generator().manual_seed(4))
    (posed.positions * weight).sum().backward()
    (positions * weight.double()).sum().backward()
    for value, oracle in zip(mine, true, strict=True):
        assert value.grad is not None
        assert oracle.grad is not None
        scale = oracle.grad.abs().max()
        torch.testing.assert_close(
            value.grad.double() / scale, oracle.grad / scale, rtol=0, atol=1e-5
        )


@settings(max_examples=25, deadline=None)
@given(
    angle=st.floats(0.0, 6.0, width=32),
    axis=st.sampled_from([(1.0, 0.0, 0.0), (0.0, -1.0, 0.0), (0.6, 0.0, 0.8)]),
    joint=st.integers(0, 15),
)
def test_any_angle_turns_as_in_float64(
    angle: float, axis: tuple[float, float, float], joint: int
) -> None:
    """Also near the limit of the series and beyond half a turn; 2e-6 m, gradients 1e-5."""
    hand = rig(correctives=False)
    pose = torch.zeros(1, 16, 3)
    pose[0, joint] = angle * torch.tensor(axis)
    mine, true = pose.clone().requires_grad_(), pose.double().requires_grad_()
    positions = hand.follow(mine, torch.zeros(10), torch.zeros(1, 3)).positions
    template, anchors = exact(hand)
    zeros = torch.zeros(10).double(), torch.zeros(1, 3).double()
    expected = anchor_positions(pose_hand(template, true, *zeros).vertices, template.faces, anchors)
    torch.testing.assert_close(positions.double(), expected, rtol=0, atol=2e-6)
    positions.square().sum().backward()
    expected.square().sum().backward()
    assert mine.grad is not None
    assert true.grad is not None
    scale = true.grad.abs().max() + 1e-3
    torch.testing.assert_close(mine.grad.double() / scale, true.grad / scale, rtol=0, atol=1e-5)


def test_threads_do_not_change_a_bit() -> None:
    hand = make_rig(load_template(), 9_000)
    before, found = torch.get_num_threads(), []
    try:
        for threads in (1, 2):
            torch.set_num_threads(threads)
            found.append(hand.follow(*given_parameters(1, shapes=False)))
    finally:
        torch.set_num_threads(before)
    assert torch.equal(found[0].positions, found[1].positions)
    assert torch.equal(found[0].orientations, found[1].orientations)
