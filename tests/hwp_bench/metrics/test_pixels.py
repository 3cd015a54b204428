"""The images that scoring accepts."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy import ndimage

from hwp_bench.base.errors import BadImage, BadPrediction, EmptyMask, ShapeMismatch
from hwp_bench.metrics.pixels import (
    Box,
    bounding_box,
    check_prediction,
    check_truth,
    composite,
    crop,
    hand_pixels,
    scored_pixels,
)

IMAGE = np.zeros((4, 5, 3), np.uint8)
MASK = np.zeros((4, 5), np.uint8)


@pytest.mark.parametrize(
    ("target", "mask", "error"),
    [
        (IMAGE.astype(np.float64), MASK, BadImage),
        (IMAGE[:, :, 0], MASK, ShapeMismatch),
        (np.zeros((4, 5, 4), np.uint8), MASK, ShapeMismatch),
        (IMAGE[:0], MASK[:0], ShapeMismatch),
        (IMAGE, MASK[:3], ShapeMismatch),
        (IMAGE, MASK[..., None], ShapeMismatch),
        (IMAGE, MASK.astype(np.int32), BadImage),
    ],
)
def test_a_bad_target_or_mask_is_named(target, mask, error):
    with pytest.raises(error, match=r"target|mask"):
        check_truth(target, mask)


def test_a_bad_prediction_is_named_and_nothing_is_resized():
    check_prediction(IMAGE, IMAGE)
    with pytest.raises(ShapeMismatch, match="own resolution"):
        check_prediction(np.zeros((8, 10, 3), np.uint8), IMAGE)
    with pytest.raises(BadPrediction, match="as_uint8"):
        check_prediction(IMAGE.astype(np.float32), IMAGE)


@given(st.integers(0, 2**32 - 1), st.integers(1, 20), st.integers(1, 20), st.sampled_from([1, 2]))
def test_erosion_takes_one_ring_and_none_at_the_frame(seed, height, width, erosion):
    rng = np.random.default_rng(seed)
    mask = ndimage.uniform_filter(rng.random((height, width)), 3) > 0.45
    expected = ndimage.binary_erosion(mask, np.ones((3, 3)), iterations=erosion, border_value=1)
    got = scored_pixels(mask.astype(np.uint8) * 255, erosion=erosion)
    np.testing.assert_array_equal(got, expected)


def test_known_coverage_is_taken_as_it_is():
    coverage = np.array([[0, 127, 128, 254, 255]], np.uint8)
    np.testing.assert_array_equal(
        scored_pixels(coverage, erosion=1, coverage=True), [[False, False, False, False, True]]
    )
    np.testing.assert_array_equal(hand_pixels(coverage), [[False, False, True, True, True]])


def test_bool_masks_mean_what_255_means():
    mask = np.pad(np.ones((4, 6), bool), 3)
    np.testing.assert_array_equal(
        scored_pixels(mask, erosion=1), scored_pixels(mask.astype(np.uint8) * 255, erosion=1)
    )


def test_an_empty_region_is_an_error_with_a_remedy():
    with pytest.raises(EmptyMask, match="no pixel is left to score"):
        bounding_box(np.zeros((5, 5), bool))


def test_box_arithmetic():
    region = np.zeros((20, 30), bool)
    region[4:7, 10:20] = True
    box = bounding_box(region)
    assert box == Box(4, 10, 7, 20)
    assert box.grown(5) == Box(-1, 5, 12, 25)
    assert box.grown(5).area == 13 * 20
    assert box.at_least(7) == Box(2, 10, 9, 20)
    assert box.at_least(6).shape == (6, 10)


def test_a_crop_beyond_the_frame_is_black():
    image = np.arange(1, 13, dtype=np.uint8).reshape(3, 4)
    np.testing.assert_array_equal(
        crop(image, Box(-1, 2, 2, 6)), [[0, 0, 0, 0], [3, 4, 0, 0], [7, 8, 0, 0]]
    )
    assert not crop(image, Box(9, 9, 12, 12)).any()


@pytest.mark.parametrize("dtype", [np.uint8, np.float64])
def test_composite_is_black_outside_and_leaves_its_input(dtype):
    image = np.full((6, 7, 3), 9, dtype)
    region = np.zeros((6, 7), bool)
    region[2:4, 1:5] = True
    out = composite(image, region)
    np.testing.assert_array_equal(out, image * region[..., None])
    assert (image == 9).all()
    assert out.dtype == dtype
