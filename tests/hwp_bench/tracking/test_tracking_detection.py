"""Regions and landmarks in them. Oracles: complex numbers, a linear picture, inverse maps."""

from __future__ import annotations

import cmath
import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from hwp_bench.tracking.networks import (
    Palm,
    Region,
    SeenHand,
    anchors,
    angle_of,
    cut_region,
    decode,
    overlap,
    palm_input,
    place_in_image,
    suppress,
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
    hand = SeenHand(points, world, 0.9, 0.8).place_in(square)
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


def test_anchors_are_those_of_the_published_options() -> None:
    # SsdAnchorsCalculator: strides 8, 16, 16, 16 at 192 px. For each layer one anchor of the aspect
    # ratio 1 and one of the interpolated scale; layers of one stride share their grid.
    strides, expected, layer = [8, 16, 16, 16], [], 0
    while layer < len(strides):
        last = layer
        while last < len(strides) and strides[last] == strides[layer]:
            last += 1
        cells = math.ceil(192 / strides[layer])
        for y in range(cells):
            for x in range(cells):
                for _ in range(2 * (last - layer)):
                    expected.append(((x + 0.5) / cells, (y + 0.5) / cells))
        layer = last
    np.testing.assert_allclose(anchors(), expected, atol=1e-12)
    assert anchors().shape == (2016, 2)


def test_decoding_follows_the_published_formula() -> None:
    rng = np.random.default_rng(0)
    values = rng.normal(0, 20, (2016, 18)).astype(np.float32)
    values[:, 2:4] = np.abs(values[:, 2:4])
    logits = np.full(2016, -9.0, np.float32)
    chosen = [5, 700, 1151, 1152, 2015]
    logits[chosen] = [0.1, 200.0, 3.0, -0.1, 1.0]
    found = decode(values, logits, 0.5)
    assert len(found) == 4  # sigmoid(-0.1) is below one half
    for palm, row in zip(found, [5, 700, 1151, 2015], strict=True):
        x, y = anchors()[row]
        raw = [float(value) / 192 for value in values[row]]
        assert palm.score == pytest.approx(1 / (1 + math.exp(-min(float(logits[row]), 100))))
        np.testing.assert_allclose(palm.low, [x + raw[0] - raw[2] / 2, y + raw[1] - raw[3] / 2])
        np.testing.assert_allclose(palm.high, [x + raw[0] + raw[2] / 2, y + raw[1] + raw[3] / 2])
        for k in range(7):
            point = [x + raw[4 + 2 * k], y + raw[5 + 2 * k]]
            np.testing.assert_allclose(palm.keypoints[k], point, atol=1e-12)


def box(x: float, y: float, width: float, height: float, score: float) -> Palm:
    low = np.array([x, y])
    keypoints = np.tile(low, (7, 1)) + np.arange(7)[:, None]
    return Palm(low, low + np.array([width, height]), keypoints, score)


def test_boxes_of_one_palm_become_their_weighted_mean() -> None:
    # Overlaps with the best: 1 and 0.8; the third box shares nothing and stays.
    found = suppress([box(50, 0, 10, 10, 0.6), box(0, 0, 8, 10, 0.3), box(0, 0, 10, 10, 0.9)])
    assert [palm.score for palm in found] == [0.9, 0.6]
    np.testing.assert_allclose(found[0].low, [0, 0])
    np.testing.assert_allclose(found[0].high, [(0.9 * 10 + 0.3 * 8) / 1.2, 10])
    np.testing.assert_allclose(found[1].low, [50, 0])


def test_a_box_with_little_overlap_is_another_palm() -> None:
    # 3 of 10 px in common: intersection over union 30 / 170 is below 0.3.
    assert len(suppress([box(0, 0, 10, 10, 0.9), box(7, 0, 10, 10, 0.8)])) == 2
    assert suppress([]) == []


def test_an_upright_palm_gives_an_upright_region_above_it() -> None:
    palm = box(40, 60, 20, 10, 1.0)
    keypoints = palm.keypoints.copy()
    keypoints[0], keypoints[2] = (50, 80), (50, 60)
    region = Palm(palm.low, palm.high, keypoints, 1.0).hand_region()
    # Centre (50, 65), moved up by half of the box's height; 2.6 times the longer side.
    assert (region.x, region.y) == pytest.approx((50, 60))
    assert (region.width, region.height) == pytest.approx((52, 52))
    assert region.rotation == pytest.approx(0)


def test_a_palm_that_points_to_the_right_turns_the_region_by_a_right_angle() -> None:
    palm = box(40, 60, 20, 20, 1.0)
    keypoints = palm.keypoints.copy()
    keypoints[0], keypoints[2] = (40, 70), (60, 70)
    region = Palm(palm.low, palm.high, keypoints, 1.0).hand_region()
    assert region.rotation == pytest.approx(math.pi / 2)
    assert (region.x, region.y) == pytest.approx((60, 70))  # moved to the fingers


def test_the_detector_sees_the_image_with_bands_and_palms_return_from_there() -> None:
    image = np.full((90, 160, 3), 200, np.uint8)
    seen = palm_input(image)
    # A height of 90 of 160 px is 108 of 192 px; the bands above and below have 42 px each. Next to
    # the picture's edges its pixels and the black are mixed.
    assert (seen[42:149, :191] == 200).all()
    assert seen[:41].max() == 0
    assert seen[150:].max() == 0
    palm = Palm(np.array([0.5, 42 / 192]), np.array([1.0, 150 / 192]), np.full((7, 2), 0.5), 1.0)
    placed = place_in_image(palm, 160, 90)
    np.testing.assert_allclose(placed.low, [80, 0], atol=1e-9)
    np.testing.assert_allclose(placed.high, [160, 90], atol=1e-9)
    np.testing.assert_allclose(placed.keypoints, np.tile([80, 45], (7, 1)))
