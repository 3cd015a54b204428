"""Regions and landmarks in them. Oracles: complex numbers, a linear picture, inverse maps."""

from __future__ import annotations

import cmath
import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from hwp_bench.tracking.detection import (
    Region,
    SeenHand,
    angle_of,
    cut_region,
    overlap,
    to_image,
)

ANGLES = st.floats(-math.pi, math.pi - 1e-6)
REGIONS = st.builds(
    Region,
    st.floats(20, 100),
    st.floats(20, 100),
    st.floats(10, 60),
    st.floats(10, 60),
    ANGLES,
)


@given(REGIONS, st.floats(0, 1), st.floats(0, 1))
def test_points_go_to_the_image_and_back(region: Region, u: float, v: float) -> None:
    place = complex(*to_image(np.array([u, v]), region))
    # The turn about the centre, as a product of complex numbers.
    local = complex((u - 0.5) * region.width, (v - 0.5) * region.height)
    expected = complex(region.x, region.y) + local * cmath.exp(1j * region.rotation)
    assert place == pytest.approx(expected)
    matrix = region.matrix()
    back = np.linalg.solve(matrix[:, :2], [place.real, place.imag] - matrix[:, 2])
    np.testing.assert_allclose(back, [u, v], atol=1e-9)


@settings(max_examples=25)
@given(REGIONS)
def test_a_crop_shows_what_lies_there(region: Region) -> None:
    # Bilinear sampling of a linear picture is exact, but for its rounding to levels and OpenCV's
    # to 1/32 px: 1.2 levels a pixel, so that 1 level is allowed.
    y, x = np.mgrid[:140, :140]
    image = np.stack([x * 1.2, y * 1.2, 100 + (x - y) * 0.5], axis=2).round().astype(np.uint8)
    crop = cut_region(image, region, 32, outside_black=False)
    row, column = np.mgrid[:32, :32]
    places = to_image(np.stack([column, row], axis=2) / 32, region)
    inside = ((places >= 1) & (places <= 138)).all(axis=2)
    assert inside.any()
    expected = places * 1.2
    np.testing.assert_allclose(crop[inside][:, :2], expected[inside], atol=1.05)


def test_the_outside_is_black_or_goes_on() -> None:
    image = np.full((20, 20, 3), 90, np.uint8)
    region = Region(20, 10, 20, 20)
    assert cut_region(image, region, 8, outside_black=True)[4].min() == 0
    assert cut_region(image, region, 8, outside_black=False).min() == 90


@given(REGIONS)
def test_angles_are_those_that_regions_have(region: Region) -> None:
    wrist, fingers = to_image(np.array([[0.5, 1.0], [0.5, 0.0]]), region)
    difference = angle_of(wrist, fingers) - region.rotation
    assert math.cos(difference) == pytest.approx(1, abs=1e-9)
    assert -math.pi <= angle_of(wrist, fingers) < math.pi


def test_overlap_is_intersection_over_union() -> None:
    one = Region(10, 10, 10, 10)
    assert overlap(one, one) == pytest.approx(1)
    assert overlap(one, Region(15, 10, 10, 10)) == pytest.approx(50 / 150)
    assert overlap(one, Region(40, 10, 10, 10)) == 0


@given(REGIONS, st.integers(0, 100))
def test_landmarks_of_a_crop_return_to_the_image(region: Region, seed: int) -> None:
    square = Region(region.x, region.y, region.width, region.width, region.rotation)
    rng = np.random.default_rng(seed)
    points = rng.uniform(0, 224, (21, 3))
    world = rng.normal(0, 0.05, (21, 3))
    hand = SeenHand(points, world, 0.9, 0.8).placed(square)
    turn = cmath.exp(1j * region.rotation)
    for k in range(21):
        local = complex(*(points[k, :2] / 224 - 0.5)) * square.width
        assert complex(*hand.image[k, :2]) == pytest.approx(
            complex(square.x, square.y) + local * turn
        )
        assert complex(*hand.world[k, :2]) == pytest.approx(complex(*world[k, :2]) * turn)
    # Depth: the network's unit, undone by 0.4, in pixels of the image.
    np.testing.assert_allclose(hand.image[:, 2], points[:, 2] / 224 / 0.4 * square.width)
    np.testing.assert_allclose(hand.world[:, 2], world[:, 2])


@given(ANGLES, st.integers(0, 100))
def test_the_next_region_turns_with_the_hand(angle: float, seed: int) -> None:
    # An open hand that points upwards; its stable landmarks lie in the box (0, 0)-(60, 80).
    points = np.random.default_rng(seed).uniform([10, 10], [50, 70], (21, 2))
    points[0], points[1], points[17] = (30, 80), (0, 60), (60, 40)
    points[[5, 9, 13]] = [(10, 5), (30, 0), (50, 5)]
    points[[4, 8, 12, 16, 20], 1] = -300  # tips do not count
    turned = [complex(*point) * cmath.exp(1j * angle) for point in points]
    image = np.array([[place.real, place.imag, 0] for place in turned])
    region = SeenHand(image, np.zeros((21, 3)), 1.0, 1.0).next_region()
    # The centre (30, 40) moves by a tenth of the height to the fingers; twice the longer side.
    centre = complex(30, 40 - 8) * cmath.exp(1j * angle)
    assert complex(region.x, region.y) == pytest.approx(centre, abs=1e-6)
    assert region.width == pytest.approx(160)
    assert math.cos(region.rotation - angle) == pytest.approx(1, abs=1e-9)
