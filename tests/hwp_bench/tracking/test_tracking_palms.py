"""Palms: anchors, decoding, suppression. Oracles: loops over the published options, and by hand."""

from __future__ import annotations

import math

import numpy as np
import pytest

from hwp_bench.tracking.detection import Palm, anchors, decode, palm_input, place_in_image, suppress


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
