"""Ray casting: the oracle is the analytic sphere; tolerances follow from its facets."""

from __future__ import annotations

from collections import Counter

import numpy as np
import pytest
import trimesh

from hwp_bench.base.embree import EmbreeMesh, library
from hwp_bench.base.ray_mesh import EmbreexMesh
from hwp_bench.sim.geometry.raycast import Tracer
from hwp_bench.sim.render.shading import openness


def test_hits_lie_on_the_sphere() -> None:
    ball = trimesh.creation.icosphere(subdivisions=4, radius=0.1)
    rays: Counter[str] = Counter()
    tracer = Tracer(ball.vertices, ball.faces, rays)
    rng = np.random.default_rng(0)
    offset = rng.uniform(-0.15, 0.15, (2000, 2))
    origins = np.column_stack([offset, np.full(2000, -1.0)])
    directions = np.tile([0.0, 0.0, 2.0], (2000, 1))
    hits = tracer.first_hits(origins, directions, "test")
    radius = np.hypot(*offset.T)
    sure = np.abs(radius - 0.1) > 0.001
    hit = np.zeros(2000, dtype=bool)
    hit[hits.ray] = True
    np.testing.assert_array_equal(hit[sure], radius[sure] < 0.1)
    # Distance counts in lengths of the direction; facets sink 0.3 mm below the sphere at most.
    places = origins[hits.ray] + hits.distance[:, None] * directions[hits.ray]
    np.testing.assert_allclose(np.linalg.norm(places, axis=1), 0.1, atol=4e-4)
    assert (places[:, 2] <= 1e-6).all()
    corners = ball.vertices[ball.faces[hits.face]]
    spread = np.einsum("nk,nkc->nc", hits.weights, corners)
    np.testing.assert_allclose(spread, places, atol=2e-5)
    np.testing.assert_array_equal(tracer.blocked(origins, directions, "more"), hit)
    assert rays == {"test": 2000, "more": 2000}


def test_openness_of_a_floor_and_of_a_corner() -> None:
    # Oracle: a wall that is endless on the scale of the reach takes its share of the half space.
    wall = np.array([[0.0, -9, -9], [0, 9, -9], [0, 9, 9], [0, -9, 9]])
    tracer = Tracer(wall, np.array([[0, 1, 2], [0, 2, 3]]), Counter())
    points = np.array([[1e-4, 0.0, 0.0], [0.5, 0.0, 0.0]])
    up = np.tile([0.0, 1.0, 0.0], (2, 1))
    near, far = openness(tracer, points, up)
    assert far == 1.0
    assert 0.45 < near < 0.62


def test_hits_equal_those_of_embreex_bit_for_bit() -> None:
    # Oracle: the package embreex itself, on a bumpy ball from one place and from many.
    ball = trimesh.creation.icosphere(subdivisions=5, radius=0.1)
    rng = np.random.default_rng(1)
    vertices = ball.vertices * rng.uniform(0.9, 1.1, (len(ball.vertices), 1))
    loaded = library()
    assert loaded is not None
    ours, plain = EmbreeMesh(loaded, vertices, ball.faces), EmbreexMesh(vertices, ball.faces)
    directions = np.array([0.0, 0.0, 1.0]) + rng.normal(0.0, 0.15, (20_000, 3))
    many = rng.normal(0.0, 0.2, (20_000, 3)) - [0.0, 0.0, 0.5]
    for origins in (np.array([[0.0, 0.0, -0.5]]), many):
        met = plain.first_hits(origins, directions)
        assert 1000 < len(met[0]) < 20_000
        for value, oracle in zip(ours.first_hits(origins, directions), met, strict=True):
            np.testing.assert_array_equal(value, oracle)
        expected = plain.blocked(origins, directions)
        np.testing.assert_array_equal(ours.blocked(origins, directions), expected)
    nothing = np.zeros((0, 3))
    assert not len(ours.blocked(nothing, nothing))
    assert not len(plain.blocked(nothing, nothing))
    assert not len(ours.first_hits(nothing, nothing)[0])


def test_a_tracer_works_through_embreex_alone(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("hwp_bench.base.embree.library", lambda: None)
    test_hits_lie_on_the_sphere()
