"""Mesh arithmetic: the oracle is trimesh."""

from __future__ import annotations

import numpy as np
import trimesh

from hwp_bench.hands.template import boundary_loop
from hwp_bench.sim.geometry.mesh import (
    normal_operator,
    smoothing,
    subdivision,
    surface_normals,
)


def test_subdivision_is_trimesh_subdivision() -> None:
    ball = trimesh.creation.icosphere(subdivisions=1)
    matrix, faces = subdivision(np.asarray(ball.faces), len(ball.vertices))
    fine = trimesh.Trimesh(matrix @ ball.vertices, faces, process=False)
    oracle = ball.subdivide()
    assert fine.is_watertight
    assert len(fine.faces) == 4 * len(ball.faces)
    np.testing.assert_allclose(fine.volume, oracle.volume, rtol=1e-12)
    np.testing.assert_allclose(fine.area, oracle.area, rtol=1e-12)
    np.testing.assert_array_equal(fine.vertices[: len(ball.vertices)], ball.vertices)


def test_subdivided_corners_follow_their_vertices() -> None:
    from hwp_bench.sim.subject.hand import _subdivide_corners

    ball = trimesh.creation.icosphere(subdivisions=0)
    matrix, faces = subdivision(np.asarray(ball.faces), len(ball.vertices))
    corners = _subdivide_corners(ball.vertices[ball.faces])
    np.testing.assert_allclose(corners, (matrix @ ball.vertices)[faces], atol=1e-12)


def test_normals_point_along_the_radius() -> None:
    ball = trimesh.creation.icosphere(subdivisions=3)
    faces = np.asarray(ball.faces)
    normals = surface_normals(ball.vertices, faces, normal_operator(faces, len(ball.vertices)))
    assert np.einsum("ni,ni->n", normals, ball.vertices).min() > 0.999


def test_smoothing_keeps_the_volume_and_the_boundary() -> None:
    ball = trimesh.creation.icosphere(subdivisions=3)
    rng = np.random.default_rng(1)
    rough = ball.vertices * (1.0 + rng.normal(0.0, 0.02, (len(ball.vertices), 1)))
    operator = smoothing(np.asarray(ball.faces), len(rough), rounds=5)
    smooth = operator @ rough
    before = trimesh.Trimesh(rough, ball.faces, process=False)
    after = trimesh.Trimesh(smooth, ball.faces, process=False)
    assert abs(after.volume / before.volume - 1.0) < 0.01
    assert np.linalg.norm(smooth, axis=1).std() < 0.5 * np.linalg.norm(rough, axis=1).std()


def test_boundary_of_an_open_cylinder_is_a_ring() -> None:
    rows, around = 3, 12
    index = np.arange(rows * around).reshape(rows, around)
    a, b = index[:-1], np.roll(index, -1, axis=1)[:-1]
    c, d = index[1:], np.roll(index, -1, axis=1)[1:]
    quads = [np.stack(face, axis=-1).reshape(-1, 3) for face in ((a, b, c), (b, d, c))]
    loop = boundary_loop(np.concatenate(quads))
    assert len(loop) == around
    assert set(loop.tolist()) in (set(index[0].tolist()), set(index[-1].tolist()))
