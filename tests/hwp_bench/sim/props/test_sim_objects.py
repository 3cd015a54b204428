"""Objects that hands hold. Oracle: geometry, by trimesh where a surface is closed."""

from __future__ import annotations

import numpy as np
import pytest
import trimesh

from hwp_bench.base.errors import BadInput
from hwp_bench.sim.geometry.surface import plain, tube
from hwp_bench.sim.props.objects import build_object, object_names


@pytest.mark.parametrize("name", object_names())
@pytest.mark.parametrize("variant", [0, 1, 5])
def test_every_object_is_sound_and_of_a_size_for_hands(name: str, variant: int) -> None:
    surface = build_object(name, variant)
    assert np.isfinite(surface.vertices).all()
    assert 0.01 < np.ptp(surface.vertices, axis=0).max() < 0.35
    # Poles of turned shapes have faces without area; they face nowhere.
    lengths = np.linalg.norm(surface.normals, axis=1)
    assert ((np.abs(lengths - 1.0) < 1e-6) | (lengths < 1e-6)).all()
    assert surface.corner_uv.shape == (len(surface.faces), 3, 2)
    assert np.isfinite(surface.corner_uv).all()
    assert surface.faces.max() < len(surface.vertices)
    assert surface.material.max() < len(surface.materials)
    assert not surface.hand.any()


@pytest.mark.parametrize(
    "name", ["mug", "ball", "spoon", "banana", "remote", "bottle", "brush", "apple", "jar", "torch"]
)
def test_faces_look_outward(name: str) -> None:
    surface = build_object(name)
    corners = surface.vertices[surface.faces]
    across = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    area = np.linalg.norm(across, axis=1)
    shown = surface.normals[surface.faces].mean(axis=1)
    agree = np.einsum("fi,fi->f", across, shown)[area > 1e-12] > 0.0
    assert agree.mean() > 0.99
    middle = surface.vertices.mean(axis=0)
    outward = np.einsum("fi,fi->f", across, corners.mean(axis=1) - middle)
    assert outward.sum() > 0.0


def test_a_tube_encloses_what_a_cylinder_would() -> None:
    spine = np.stack([np.zeros(21), np.zeros(21), np.linspace(0.0, 0.1, 21)], axis=1)
    surface = tube(spine, np.full(21, 0.01), plain((0.5, 0.5, 0.5)), around=64)
    mesh = trimesh.Trimesh(surface.vertices, surface.faces, process=True)
    mesh.merge_vertices()
    assert mesh.volume == pytest.approx(np.pi * 0.01**2 * 0.1, rel=0.01)


def test_an_unknown_object_names_the_known_ones() -> None:
    with pytest.raises(BadInput, match=r"there is no object 'anvil'.*mug"):
        build_object("anvil")
