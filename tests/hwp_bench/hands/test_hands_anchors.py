"""Surface anchors: even spread, motion with the mesh, finite differences."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
import pytest
import torch
import trimesh
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from hwp_bench.base.errors import BadHandModel, UsageError
from hwp_bench.hands import (
    HandParameters,
    HandTemplate,
    SurfaceAnchors,
    anchor_frames,
    anchor_normals,
    anchor_positions,
    anchor_uv,
    pose_hand,
    sample_surface,
    subdivide,
    to_trimesh,
    vertex_normals,
)
from hwp_bench.hands.anchors import Footprint, HandSurfaces
from hwp_bench.hands.raster import draw_silhouette
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


def test_normals_are_trimeshs_area_weighted_means(free_right: HandTemplate) -> None:
    mesh = to_trimesh(free_right.vertices, free_right.faces)
    expected = trimesh.geometry.mean_vertex_normals(
        len(mesh.vertices), mesh.faces, mesh.face_normals * mesh.area_faces[:, None]
    )
    vertices = torch.from_numpy(free_right.vertices).expand(2, -1, -1)
    ours = vertex_normals(vertices, torch.from_numpy(free_right.faces))
    np.testing.assert_allclose(ours[0], expected, atol=1e-10)
    torch.testing.assert_close(ours[0], ours[1])


def test_normals_of_a_sphere_point_outwards() -> None:
    sphere = trimesh.creation.icosphere(subdivisions=4)
    normals = vertex_normals(torch.tensor(sphere.vertices), torch.tensor(sphere.faces))
    cosine = (normals.numpy() * sphere.vertices).sum(axis=1)
    assert cosine.min() > 0.9999


def test_degenerate_faces_give_finite_normals_and_no_gradient() -> None:
    faces = torch.tensor([[0, 1, 2], [0, 0, 1]])
    for dtype in (torch.float32, torch.float64):
        vertices = torch.zeros(4, 3, dtype=dtype, requires_grad=True)
        normals = vertex_normals(vertices, faces)
        np.testing.assert_array_equal(normals.detach(), [[0.0, 0.0, 1.0]] * 4)
        normals.sum().backward()
        assert vertices.grad is not None
        assert not vertices.grad.any()


SIZE, FRAMES = 96, 3
K = np.array([[1.4 * SIZE, 0.0, SIZE / 2], [0.0, 1.4 * SIZE, SIZE / 2], [0.0, 0.0, 1.0]])
# Across the image from frame to frame, m, at this depth, m.
STEP, DEPTH = 0.01, 0.45


def moving(side: str = "right") -> HandParameters:
    """A hand upright before the camera that bends a little and moves to the right."""
    pose = np.random.default_rng(3).normal(0.0, 0.08, (1, 16, 3)).repeat(FRAMES, axis=0)
    pose[:, 0] = [np.pi / 2, 0.0, 0.0]
    towards = 0.09 if side == "right" else -0.09
    transl = np.stack(
        [towards + STEP * np.arange(FRAMES), np.zeros(FRAMES), np.full(FRAMES, DEPTH)], axis=1
    )
    return HandParameters(
        pose=pose, betas=np.zeros(10), transl=transl, valid=np.ones(FRAMES, dtype=bool)
    )


def drawn(
    templates: Mapping[str, HandTemplate], hands: Mapping[str, HandParameters]
) -> list[Footprint]:
    surfaces = HandSurfaces(templates, 0.004)
    views = np.eye(4)[None].repeat(FRAMES, axis=0)
    Ks = K[None].repeat(FRAMES, axis=0)
    return list(surfaces.footprints(hands, Ks, views, np.arange(FRAMES), (SIZE, SIZE)))


def posed(template: HandTemplate, hand: HandParameters, frame: int) -> trimesh.Trimesh:
    tensors = template.to_torch()
    vertices = pose_hand(
        tensors,
        torch.as_tensor(hand.pose[frame : frame + 1], dtype=torch.float32),
        torch.as_tensor(hand.betas, dtype=torch.float32),
        torch.as_tensor(hand.transl[frame : frame + 1], dtype=torch.float32),
    ).vertices[0]
    return trimesh.Trimesh(vertices.numpy(), template.faces, process=False)


def test_the_silhouette_is_that_of_the_posed_mesh(free_right: HandTemplate) -> None:
    hand = moving()
    for frame, footprint in enumerate(drawn({"right": free_right}, {"right": hand})):
        vertices = posed(free_right, hand, frame).vertices
        pixels = vertices[:, :2] / vertices[:, 2:] * K[0, 0] + SIZE / 2
        expected = draw_silhouette(pixels, free_right.faces, SIZE) > 0
        np.testing.assert_array_equal(footprint.silhouette, expected)
        np.testing.assert_array_equal(footprint.pixels, np.flatnonzero(expected))


def test_normals_are_unit_and_as_trimesh_has_them(free_right: HandTemplate) -> None:
    hand = moving()
    footprint = drawn({"right": free_right}, {"right": hand})[0]
    mesh = posed(free_right, hand, 0)
    np.testing.assert_allclose(np.linalg.norm(footprint.normals, axis=1), 1.0, atol=1e-4)
    # Where the mesh's normals lie on average, and towards the camera almost everywhere.
    rays = np.stack(
        [footprint.pixels % SIZE + 0.5 - SIZE / 2, footprint.pixels // SIZE + 0.5 - SIZE / 2],
        axis=1,
    )
    ways = np.column_stack([rays / K[0, 0], np.ones(len(rays))])
    places, index_ray, faces = mesh.ray.intersects_location(
        np.zeros_like(ways), ways, multiple_hits=False
    )
    assert len(places) > 0.98 * len(ways)
    agree = np.einsum("pi,pi->p", footprint.normals[index_ray], mesh.face_normals[faces])
    assert np.quantile(agree, 0.02) > 0.8
    assert np.median(agree) > 0.99
    assert np.mean(footprint.facing > 0.0) > 0.97


def test_motion_is_that_of_the_image(free_right: HandTemplate) -> None:
    found = [print_.motion for print_ in drawn({"right": free_right}, {"right": moving()})]
    assert found[0] == 0.0
    assert found[1:] == pytest.approx([STEP / DEPTH * K[0, 0]] * 2, rel=0.08)


def test_a_place_keeps_its_cell_and_hands_share_none(
    free_right: HandTemplate, free_left: HandTemplate
) -> None:
    hands = {"right": moving(), "left": moving("left")}
    templates = {"right": free_right, "left": free_left}
    alone = {side: drawn({side: templates[side]}, {side: hands[side]}) for side in hands}
    first, second = alone["right"][0], alone["right"][1]
    shared = np.intersect1d(first.cells, second.cells)
    assert len(shared) > 0.6 * len(np.unique(first.cells))
    both = drawn(templates, hands)[0]
    only_right = both.cells[
        np.isin(both.pixels, np.setdiff1d(first.pixels, alone["left"][0].pixels))
    ]
    only_left = both.cells[
        np.isin(both.pixels, np.setdiff1d(alone["left"][0].pixels, first.pixels))
    ]
    assert len(only_right) > 100
    assert len(only_left) > 100
    assert not np.isin(only_right, only_left).any()
