"""Outlines of masks and meshes. Oracles: distances of circles."""

from __future__ import annotations

import numpy as np
import pytest
from synthetic_clip import make_clip

from hwp_bench.hands.template import boundary_vertices
from hwp_bench.importers.video.clip_masks import beyond_wrist
from hwp_bench.importers.video.contour import FIELD_SIZE, match_outline, signed_distance


def disc(centre: np.ndarray, radius: float, corners: int = 120) -> tuple[np.ndarray, np.ndarray]:
    """Vertices (centre first) and faces of a disc."""
    angle = np.arange(corners) * 2 * np.pi / corners
    rim = centre + radius * np.stack([np.cos(angle), np.sin(angle)], axis=1)
    index = np.arange(corners)
    faces = np.stack([0 * index, 1 + index, 1 + (index + 1) % corners], axis=1)
    return np.concatenate([centre[None], rim]), faces


def disc_mask(centre: np.ndarray, radius: float, size: int = FIELD_SIZE) -> np.ndarray:
    rows, columns = np.mgrid[:size, :size] + 0.5
    inside = (columns - centre[0]) ** 2 + (rows - centre[1]) ** 2 < radius**2
    return (inside * 255).astype(np.uint8)


def test_the_signed_distance_of_a_disc() -> None:
    # Exact but for the staircase of the mask: 0.75 px.
    centre, radius = np.array([90.0, 100.0]), 40.0
    rows, columns = np.mgrid[:FIELD_SIZE, :FIELD_SIZE] + 0.5
    truth = np.hypot(columns - centre[0], rows - centre[1]) - radius
    field = signed_distance(disc_mask(centre, radius)).astype(float)
    # Deep inside the nearest outline pixel is a matter of taste; float16 adds a little.
    np.testing.assert_allclose(field, truth, atol=0.75)


@pytest.mark.parametrize("level", [0, 255])
def test_a_mask_without_outline_has_no_field(level: int) -> None:
    assert not signed_distance(np.full((64, 64), level, dtype=np.uint8)).any()


@pytest.mark.parametrize("growth", [-4.0, 0.0, 3.0, 5.0])
def test_outline_vertices_are_drawn_along_their_normals(growth: float) -> None:
    centre, radius = np.array([96.0, 96.0]), 40.0
    vertices, faces = disc(centre, radius)
    field = signed_distance(disc_mask(centre, radius + growth))
    found = match_outline(vertices, faces, np.arange(len(vertices)), field, reach=8.0)
    used = np.abs(found.normal).sum(axis=1) > 0
    assert used.sum() == len(vertices) - 1  # all but the centre
    outward = (vertices[found.index] - centre) / radius
    assert (found.normal * outward).sum(axis=1)[used].min() > 0.98
    way = found.target - (found.normal * vertices[found.index]).sum(axis=1)
    assert abs(way[used].mean() - growth) < 0.3
    assert np.abs(way[used] - growth).max() < 1.0


def test_a_side_never_snaps_to_the_opposite_side() -> None:
    # The mask is a ring whose hole begins 3 px inside the mesh's outline: nearest to a vertex
    # is the hole's edge, but that faces inwards.
    centre = np.array([96.0, 96.0])
    vertices, faces = disc(centre, 40.0)
    ring = disc_mask(centre, 45.0) - disc_mask(centre, 37.0)
    field = signed_distance(ring)
    found = match_outline(vertices, faces, np.arange(len(vertices)), field, reach=8.0)
    used = np.abs(found.normal).sum(axis=1) > 0
    way = found.target - (found.normal * vertices[found.index]).sum(axis=1)
    assert used.any()
    assert np.abs(way[used] - 5.0).max() < 1.0


def test_out_of_reach_means_no_pull() -> None:
    vertices, faces = disc(np.array([60.0, 60.0]), 20.0)
    field = signed_distance(disc_mask(np.array([150.0, 150.0]), 20.0))
    found = match_outline(vertices, faces, np.arange(len(vertices)), field, reach=8.0)
    assert not found.normal.any()
    assert not found.target.any()


def test_the_forearm_lies_beyond_the_wrist() -> None:
    clip = make_clip(3)
    ring = boundary_vertices(clip.template.faces)
    for frame in range(3):
        pixels = clip.vertex_pixels[frame]
        beyond = beyond_wrist(clip.vertices[frame], pixels, ring, 320)
        x, y = clip.landmarks.image[frame, 9].astype(int)
        assert not beyond[y, x]
        wrist = pixels[ring].mean(axis=0)
        x, y = (wrist + 0.4 * (wrist - clip.landmarks.image[frame, 9])).astype(int)
        assert beyond[y, x]
    assert not beyond_wrist(clip.vertices[0], pixels, ring[:2], 320).any()
