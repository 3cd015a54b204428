"""Ray casting: the oracle is the analytic sphere; tolerances follow from its facets."""

from __future__ import annotations

from collections import Counter
from dataclasses import replace

import numpy as np
import pytest
import trimesh
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from hwp_bench.base.rays import EmbreeMesh, EmbreexMesh, library, places_on_faces
from hwp_bench.sim.geometry.surface import Tracer
from hwp_bench.sim.light.shading import openness


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


def _bumpy_ball() -> tuple[np.ndarray, np.ndarray]:
    ball = trimesh.creation.icosphere(subdivisions=5, radius=0.1)
    bumps = np.random.default_rng(1).uniform(0.9, 1.1, (len(ball.vertices), 1))
    return ball.vertices * bumps, ball.faces


def _rays_of(count: int) -> tuple[np.ndarray, list[np.ndarray]]:
    """Directions, and origins: one for all, and one for each."""
    rng = np.random.default_rng(2)
    directions = np.array([0.0, 0.0, 1.0]) + rng.normal(0.0, 0.15, (count, 3))
    many = rng.normal(0.0, 0.2, (count, 3)) - [0.0, 0.0, 0.5]
    return directions, [np.array([[0.0, 0.0, -0.5]]), many]


def test_hits_equal_those_of_embreex_bit_for_bit() -> None:
    # Oracle: the package embreex itself, on a bumpy ball from one place and from many.
    vertices, faces = _bumpy_ball()
    loaded = library()
    assert loaded is not None
    ours, plain = EmbreeMesh(loaded, vertices, faces), EmbreexMesh(vertices, faces)
    directions, starts = _rays_of(20_000)
    for origins in starts:
        met = plain.first_hits(origins, directions)
        assert 1000 < len(met[0]) < 20_000
        for value, oracle in zip(ours.first_hits(origins, directions), met, strict=True):
            np.testing.assert_array_equal(value, oracle)
        expected = plain.blocked(origins, directions)
        np.testing.assert_array_equal(ours.blocked(origins, directions), expected)
    nothing = np.zeros((0, 3))
    for mesh in (ours, plain):
        assert not len(mesh.blocked(nothing, nothing))
        assert all(not len(values) for values in mesh.first_hits(nothing, nothing))


@pytest.mark.parametrize("instructions", [b"", b"isa=sse4.2"])
def test_places_do_not_depend_on_the_processors_instructions(instructions: bytes) -> None:
    # Oracle: Embree with the newest instructions of this processor, and with those of an older one,
    # which has other approximate reciprocals. Along an edge either may meet the neighbour.
    vertices, faces = _bumpy_ball()
    loaded = library()
    assert loaded is not None
    device = loaded.call("rtcNewDevice", b"threads=1," + instructions)
    ours, other = (
        EmbreeMesh(one, vertices, faces) for one in (loaded, replace(loaded, device=device))
    )
    directions, starts = _rays_of(50_000)
    for origins in starts:
        (ray, *hits), (other_ray, *oracle) = (
            mesh.first_hits(origins, directions) for mesh in (ours, other)
        )
        np.testing.assert_array_equal(ray, other_ray)
        same = hits[0] == oracle[0]
        assert np.count_nonzero(~same) <= 2
        for value, expected in zip(hits, oracle, strict=True):
            np.testing.assert_array_equal(value[same], expected[same])


@given(arrays(np.float64, (3, 3), elements=st.floats(-0.1, 0.1)), st.integers(0, 2**32 - 1))
def test_a_place_is_on_its_face_and_on_the_ray(corners: np.ndarray, seed: int) -> None:
    # Oracle: the ray is aimed at a known place. Single precision of the vertices is 1e-8 m.
    rng = np.random.default_rng(seed)
    weights = rng.dirichlet(np.ones(3))
    aim = weights @ corners
    origin = aim + rng.normal(0.0, 1.0, 3)
    direction = (aim - origin) * rng.uniform(0.5, 2.0)
    vertices, faces = corners.astype(np.float32), np.arange(3)[None]
    first = np.zeros(1, np.int64)
    u, v, distance = places_on_faces(vertices, faces, origin[None], direction[None], first, first)
    assert np.isfinite(distance).all()
    assert u[0] >= 0.0
    assert v[0] >= 0.0
    assert float(u[0]) + float(v[0]) <= 1.0 + 1e-6
    place = corners[0] + u[0] * (corners[1] - corners[0]) + v[0] * (corners[2] - corners[0])
    normal = np.cross(corners[1] - corners[0], corners[2] - corners[0])
    slope = abs(normal @ direction) / (np.linalg.norm(normal) * np.linalg.norm(direction) + 1e-12)
    if slope > 0.05 and np.linalg.norm(normal) > 1e-4:
        np.testing.assert_allclose(place, aim, atol=1e-5)
        np.testing.assert_allclose(origin + distance[0] * direction, aim, atol=1e-5)


def test_a_tracer_works_through_embreex_alone(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("hwp_bench.base.rays.library", lambda: None)
    test_hits_lie_on_the_sphere()
