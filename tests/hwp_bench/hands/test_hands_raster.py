"""Which pixels a mesh covers. Oracles: discs, planes, and matplotlib's point-in-polygon test."""

from __future__ import annotations

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st
from matplotlib.path import Path as Polygon
from synthetic_clip import disc

from hwp_bench.hands.raster import draw_faces, draw_silhouette, mix_corners


@settings(deadline=None)  # the first call compiles
@given(st.floats(60, 100), st.floats(60, 100), st.floats(8, 50))
def test_the_silhouette_of_a_disc_is_the_pixels_whose_centres_it_holds(
    x: float, y: float, radius: float
) -> None:
    vertices, faces = disc(np.array([x, y]), radius)
    drawn = draw_silhouette(vertices, faces, 160) > 0
    rows, columns = np.mgrid[:160, :160] + 0.5
    distance = np.hypot(columns - x, rows - y)
    # The disc has 120 corners: between the circles within and around it either is right.
    assert drawn[distance < radius * np.cos(np.pi / 120) - 1e-9].all()
    assert not drawn[distance > radius + 1e-9].any()


def test_silhouettes_bear_anything() -> None:
    faces = np.array([[0, 1, 2]])
    wild = np.array([[np.nan, 0], [1e30, 5], [-1e30, 9]])
    assert not draw_silhouette(wild, faces, 20).any()
    assert draw_silhouette(np.array([[-1e9, -1e9], [1e9, -1e9], [0, 1e9]]), faces, 20).all()
    assert not draw_silhouette(np.array([[50.0, 50], [60, 50], [50, 60]]), faces, 20).any()


def test_random_triangles_cover_the_pixel_centres_inside_them() -> None:
    random = np.random.default_rng(0)
    pixels = random.uniform(-10, 74, (90, 2))
    faces = np.arange(90).reshape(30, 3)
    rows, columns = np.mgrid[:64, :64] + 0.5
    centres = np.stack([columns.ravel(), rows.ravel()], axis=1)
    inside = np.any([Polygon(pixels[face]).contains_points(centres) for face in faces], axis=0)
    np.testing.assert_array_equal(draw_silhouette(pixels, faces, 64).ravel() > 0, inside)


def test_a_pixel_centre_on_an_edge_belongs_to_both_faces() -> None:
    # Two triangles of a square whose corners and diagonal go through pixel centres.
    pixels = np.array([[1.5, 1.5], [9.5, 1.5], [9.5, 9.5], [1.5, 9.5]])
    drawn = draw_silhouette(pixels, np.array([[0, 1, 2], [0, 2, 3]]), 12)
    assert (drawn[1:10, 1:10] == 255).all()
    assert (drawn > 0).sum() == 81


def test_the_nearer_face_wins_and_corners_mix() -> None:
    pixels = np.array([[0, 0], [40.3, 0], [0, 40.3]] * 2, dtype=np.float64)
    depth = np.array([2.0, 2.0, 2.0, 1.0, 3.0, 3.0])
    faces = np.array([[0, 1, 2], [3, 4, 5]])
    face, mix = draw_faces(pixels, depth, faces, (32, 32))
    # The second is nearer where 1 + 2 (x + y) / 40.3 < 2.
    x, y = np.meshgrid(np.arange(32) + 0.5, np.arange(32) + 0.5)
    inside = x + y < 40.3
    np.testing.assert_array_equal(face[inside], np.where(x + y < 20.15, 1, 0)[inside])
    shown = face.reshape(-1) >= 0
    mixed = mix_corners(pixels, faces, face.reshape(-1)[shown], mix.reshape(-1, 2)[shown])
    places = np.stack([x.reshape(-1)[shown], y.reshape(-1)[shown]], axis=1)
    np.testing.assert_allclose(mixed, places, atol=1e-4)


def test_faces_behind_the_camera_or_not_finite_are_left_out() -> None:
    pixels = np.array([[0, 0], [40, 0], [0, 40], [np.nan, 0], [40, 0], [0, 40]])
    depth = np.array([1.0, -1.0, 1.0, 1.0, 1.0, 1.0])
    face, _ = draw_faces(pixels, depth, np.array([[0, 1, 2], [3, 4, 5]]), (8, 8))
    assert (face == -1).all()
