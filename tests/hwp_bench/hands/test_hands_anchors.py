"""Surface anchors: even spread, motion with the mesh, finite differences."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from hwp_bench.base.errors import BadHandModel, UsageError
from hwp_bench.hands import (
    HandTemplate,
    SurfaceAnchors,
    anchor_frames,
    anchor_normals,
    anchor_positions,
    anchor_uv,
    sample_surface,
    subdivide,
    vertex_normals,
)
from hwp_bench.hands.template import rebuilt


def tensors_of(template: HandTemplate) -> tuple[torch.Tensor, torch.Tensor]:
    return torch.from_numpy(template.vertices), torch.from_numpy(template.faces)


def face_areas(template: HandTemplate) -> np.ndarray:
    a, b, c = np.moveaxis(template.vertices[template.faces], 1, 0)
    return 0.5 * np.linalg.norm(np.cross(b - a, c - a), axis=1)


@pytest.mark.parametrize("count", [1, 7, 5000, 49281])
def test_every_face_gets_its_share_of_the_area(free_right: HandTemplate, count: int) -> None:
    anchors = sample_surface(free_right, count)
    assert len(anchors) == count
    areas = face_areas(free_right)
    shares = count * areas / areas.sum()
    got = np.bincount(anchors.face_index, minlength=len(areas))
    assert np.abs(got - shares).max() <= 1.0 + 1e-6
    mix = np.asarray(anchors.barycentric)
    assert mix.min() >= 0.0
    np.testing.assert_allclose(mix.sum(axis=1), 1.0, atol=1e-15)


def test_points_fill_a_face_evenly() -> None:
    """In one triangle: the quarters of a midpoint split get a quarter each, within 1 %."""
    triangle = SurfaceAnchors(*one_face(20000))
    mix = np.asarray(triangle.barycentric)
    corner = (mix > 0.5).mean(axis=0)
    np.testing.assert_allclose(corner, 0.25, atol=0.01 * 0.25)


def one_face(count: int) -> tuple[np.ndarray, np.ndarray]:
    from hwp_bench.hands.template import make_template

    flat = make_template(
        name="triangle",
        side="right",
        vertices=np.eye(3),
        faces=np.array([[0, 1, 2]]),
        shape_basis=np.zeros((3, 3, 10)),
        pose_basis=None,
        joints=np.zeros((16, 3)),
        joint_basis=np.zeros((16, 3, 10)),
        weights=np.full((3, 16), 1 / 16),
        mean_pose=np.zeros(45),
        uv=np.eye(3)[:, :2],
        face_uv=np.array([[0, 1, 2]]),
        fingertips=np.zeros(5, dtype=np.int64),
    )
    anchors = sample_surface(flat, count)
    return np.asarray(anchors.face_index), np.asarray(anchors.barycentric)


def test_anchors_are_spread_better_than_chance(free_right: HandTemplate) -> None:
    """Nearest neighbours are farther apart than those of independent uniform points."""
    anchors = sample_surface(free_right, 10000)
    points = anchor_positions(*tensors_of(free_right), anchors).numpy()
    random = np.random.default_rng(0)
    areas = face_areas(free_right)
    face = random.choice(len(areas), size=10000, p=areas / areas.sum())
    mix = random.dirichlet([1.0, 1.0, 1.0], size=10000)
    chance = anchor_positions(*tensors_of(free_right), SurfaceAnchors(face, mix)).numpy()

    def mean_gap(cloud: np.ndarray) -> float:
        return float(cKDTree(cloud).query(cloud, k=2)[0][:, 1].mean())

    assert mean_gap(points) > 1.15 * mean_gap(chance)


def test_seeds_repeat_and_differ(free_right: HandTemplate) -> None:
    first, again, other = (sample_surface(free_right, 1000, seed) for seed in (3, 3, 4))
    np.testing.assert_array_equal(first.barycentric, again.barycentric)
    np.testing.assert_array_equal(first.face_index, again.face_index)
    assert not np.array_equal(first.barycentric, other.barycentric)


def test_anchors_on_vertices_are_the_vertices(free_right: HandTemplate) -> None:
    _, first = np.unique(free_right.faces, return_index=True)
    anchors = SurfaceAnchors(first // 3, np.eye(3)[first % 3])
    vertices, faces = tensors_of(free_right)
    torch.testing.assert_close(anchor_positions(vertices, faces, anchors), vertices)
    torch.testing.assert_close(
        anchor_normals(vertices, faces, anchors), vertex_normals(vertices, faces)
    )


def test_tensors_and_arrays_are_the_same_anchors(free_right: HandTemplate) -> None:
    anchors = sample_surface(free_right, 50)
    moved = anchors.to_torch(torch.float64)
    assert isinstance(moved.barycentric, torch.Tensor)
    inputs = tensors_of(free_right)
    for function in (anchor_positions, anchor_normals, anchor_frames):
        torch.testing.assert_close(function(*inputs, anchors), function(*inputs, moved))
    np.testing.assert_array_equal(anchor_uv(free_right, anchors), anchor_uv(free_right, moved))


def test_texture_coordinates_survive_subdivision(free_right: HandTemplate) -> None:
    """The same places on the fine mesh have the same texture coordinates."""
    fine = subdivide(free_right)
    coarse_anchors = anchors_from_faces(free_right)
    fine_anchors = SurfaceAnchors(
        4 * np.arange(len(free_right.faces)) + 3, np.full((len(free_right.faces), 3), 1 / 3)
    )
    np.testing.assert_allclose(
        anchor_positions(*tensors_of(fine), fine_anchors),
        anchor_positions(*tensors_of(free_right), coarse_anchors),
        atol=1e-15,
    )
    np.testing.assert_allclose(
        anchor_uv(fine, fine_anchors), anchor_uv(free_right, coarse_anchors), atol=1e-14
    )


def anchors_from_faces(template: HandTemplate) -> SurfaceAnchors:
    count = len(template.faces)
    return SurfaceAnchors(np.arange(count), np.full((count, 3), 1 / 3))


def test_frames_are_rotations_that_turn_with_the_hand(free_right: HandTemplate) -> None:
    anchors = sample_surface(free_right, 300)
    vertices, faces = tensors_of(free_right)
    turn = torch.from_numpy(Rotation.from_rotvec([0.5, -1.2, 2.0]).as_matrix())
    frames = anchor_frames(torch.stack([vertices, vertices @ turn.T + 3.0]), faces, anchors)
    gram = frames.mT @ frames
    torch.testing.assert_close(gram, torch.eye(3, dtype=torch.float64).expand_as(gram))
    torch.testing.assert_close(torch.linalg.det(frames), torch.ones(2, 300, dtype=torch.float64))
    torch.testing.assert_close(frames[1], turn @ frames[0], rtol=0, atol=1e-10)
    normals = anchor_normals(vertices, faces, anchors)
    torch.testing.assert_close(frames[0, :, :, 2], normals)


def test_gradients_agree_with_finite_differences(tiny_template: HandTemplate) -> None:
    anchors = sample_surface(tiny_template, 6)
    vertices, faces = tensors_of(tiny_template)
    for function in (anchor_positions, anchor_normals, anchor_frames):
        assert torch.autograd.gradcheck(
            lambda v, chosen=function: chosen(v, faces, anchors),
            (vertices.clone().requires_grad_(),),
        )


def test_frames_on_degenerate_faces_are_rotations_with_finite_gradients() -> None:
    faces = torch.tensor([[0, 1, 2], [0, 0, 1]])
    anchors = SurfaceAnchors(np.array([0, 1]), np.full((2, 3), 1 / 3))
    for points in (torch.zeros(3, 3), torch.tensor([[0.0, 0, 0], [0, 0, 1], [0, 0, 2]])):
        vertices = points.clone().requires_grad_()
        frames = anchor_frames(vertices, faces, anchors)
        torch.testing.assert_close(frames.mT @ frames, torch.eye(3).expand(2, 3, 3))
        frames.sum().backward()
        assert vertices.grad is not None
        assert torch.isfinite(vertices.grad).all()


def test_senseless_requests_are_refused(tiny_template: HandTemplate) -> None:
    with pytest.raises(UsageError):
        sample_surface(tiny_template, 0)
    with pytest.raises(BadHandModel):
        sample_surface(rebuilt(tiny_template, vertices=np.zeros((7, 3))), 5)
