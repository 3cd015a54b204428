"""Outlines. Oracle: discs and shifted squares, whose gaps are known."""

from __future__ import annotations

import numpy as np
import pytest

from wildghand.subject.outlines import MaskOutline, compare_outlines, outward_distance

SIZE = 64
MIDDLE, RADIUS = np.array([31.3, 32.6]), 15.0


def fan(radius: float, middle: np.ndarray = MIDDLE) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Vertices, depth and faces of a disc."""
    angle = np.linspace(0.0, 2.0 * np.pi, 64, endpoint=False)
    ring = middle + radius * np.column_stack([np.cos(angle), np.sin(angle)])
    index = np.arange(64)
    faces = np.column_stack([np.zeros(64, int), 1 + index, 1 + (index + 1) % 64])
    return np.vstack([middle, ring]), np.full(65, 0.5), faces


def outline(radius: float, middle: np.ndarray = MIDDLE) -> MaskOutline:
    return MaskOutline.of(disc(radius, middle))


def disc(radius: float, middle: np.ndarray = MIDDLE) -> np.ndarray:
    rows, columns = np.mgrid[:SIZE, :SIZE] + 0.5
    inside: np.ndarray = np.hypot(columns - middle[0], rows - middle[1]) < radius
    return inside


@pytest.mark.parametrize("grown", [-3.0, -1.0, 0.0, 0.7, 2.0, 4.0])
def test_the_gap_of_a_grown_disc_is_its_growth(grown: float) -> None:
    seen = compare_outlines(*fan(RADIUS), outline(RADIUS + grown))
    assert len(seen.gap) > 60
    # Tolerance: both outlines are rounded to pixels.
    assert np.abs(np.mean(seen.gap) - grown) < 0.35
    assert np.abs(seen.gap - grown).max() < 1.0


def test_the_gaps_of_a_shifted_disc_are_its_shift() -> None:
    shift = np.array([1.5, -0.8])
    vertices, depth, faces = fan(RADIUS)
    seen = compare_outlines(vertices, depth, faces, outline(RADIUS, MIDDLE + shift))
    solved = np.linalg.lstsq(seen.outward, seen.gap, rcond=None)[0]
    np.testing.assert_allclose(solved, shift, atol=0.35)
    np.testing.assert_allclose(np.linalg.norm(seen.outward, axis=1), 1.0, atol=1e-4)
    # Outward is away from the middle, at the point that the face and its corners say.
    place = np.einsum("mc,mck->mk", seen.mix, vertices[faces[seen.face]])
    np.testing.assert_allclose(seen.mix.sum(axis=1), 1.0, atol=1e-6)
    away = place - MIDDLE
    away /= np.linalg.norm(away, axis=1, keepdims=True)
    assert ((away * seen.outward).sum(axis=1) > 0.9).all()
    assert (np.abs(np.linalg.norm(place - MIDDLE, axis=1) - RADIUS) < 1.5).all()


@pytest.mark.parametrize("grown", [-3.0, 2.0])
def test_what_is_around_a_hand_does_not_change_its_outline(grown: float) -> None:
    """Oracle: the same disc with nothing but background up to the borders of a larger image."""
    vertices, depth, faces = fan(RADIUS)
    mask = disc(RADIUS + grown)
    small = compare_outlines(vertices, depth, faces, MaskOutline.of(mask))
    larger = MaskOutline.of(np.pad(mask, ((70, 20), (30, 50))))
    seen = compare_outlines(vertices + np.array([30.0, 70.0]), depth, faces, larger)
    np.testing.assert_array_equal(seen.face, small.face)
    for name in ("mix", "outward", "gap"):
        np.testing.assert_allclose(getattr(seen, name), getattr(small, name), atol=1e-5)


def test_the_edge_of_the_image_is_no_outline() -> None:
    middle = np.array([60.0, 32.0])
    vertices, depth, faces = fan(RADIUS, middle)
    seen = compare_outlines(vertices, depth, faces, outline(RADIUS, middle))
    place = np.einsum("mc,mck->mk", seen.mix, vertices[faces[seen.face]])
    assert len(place)
    assert (place[:, 0] < SIZE - 3).all()


@pytest.mark.parametrize("value", [False, True])
def test_a_mask_without_an_outline_says_nothing(value: bool) -> None:
    mask = MaskOutline.of(np.full((SIZE, SIZE), value))
    assert not len(compare_outlines(*fan(RADIUS), mask).gap)


def test_a_hand_outside_the_image_says_nothing() -> None:
    seen = compare_outlines(*fan(RADIUS, np.array([-200.0, 10.0])), outline(RADIUS))
    assert not len(seen.gap)


def test_distances_are_positive_outside() -> None:
    distance = outward_distance(disc(RADIUS))
    rows, columns = np.mgrid[:SIZE, :SIZE] + 0.5
    truth = np.hypot(columns - MIDDLE[0], rows - MIDDLE[1]) - RADIUS
    assert np.abs(distance - truth).max() < 0.9
    assert abs(float((distance - truth).mean())) < 0.2
