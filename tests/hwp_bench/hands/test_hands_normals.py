"""Normals against trimesh (1e-12) and finite differences; degenerate meshes stay finite."""

from __future__ import annotations

import numpy as np
import torch
import trimesh

from hwp_bench.hands import HandTemplate, to_trimesh, vertex_normals


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


def test_normals_of_hands_point_outwards(free_right: HandTemplate, free_left: HandTemplate) -> None:
    for hand in (free_right, free_left):
        assert to_trimesh(hand.vertices, hand.faces).volume > 0.0


def test_gradients_agree_with_finite_differences(tiny_template: HandTemplate) -> None:
    vertices = torch.from_numpy(tiny_template.vertices).requires_grad_()
    faces = torch.from_numpy(tiny_template.faces)
    assert torch.autograd.gradcheck(lambda v: vertex_normals(v, faces), (vertices,))


def test_degenerate_faces_give_finite_normals_and_no_gradient() -> None:
    faces = torch.tensor([[0, 1, 2], [0, 0, 1]])
    for dtype in (torch.float32, torch.float64):
        vertices = torch.zeros(4, 3, dtype=dtype, requires_grad=True)
        normals = vertex_normals(vertices, faces)
        np.testing.assert_array_equal(normals.detach(), [[0.0, 0.0, 1.0]] * 4)
        normals.sum().backward()
        assert vertices.grad is not None
        assert not vertices.grad.any()
