"""What scoring accepts; quantization by hand."""

from __future__ import annotations

import numpy as np
import pytest

from hwp_bench.base.errors import BadImage, BadPrediction, ShapeMismatch
from hwp_bench.metrics.pixels import check_prediction, check_truth, quantize


def test_quantize_clips_and_rounds_half_to_even():
    # Halves in float64: k + 0.5 levels over 255 times 255 may not be exact, so take those that are.
    levels = np.arange(255) + 0.5
    halves = levels / 255.0
    exact = halves * 255.0 == levels
    expected = np.where(np.arange(255) % 2 == 0, np.arange(255), np.arange(255) + 1)
    assert exact.sum() > 100
    np.testing.assert_array_equal(quantize(halves)[exact], expected[exact])
    np.testing.assert_array_equal(quantize(np.array([-3.0, 0.0, 1.0, 7.0])), [0, 0, 255, 255])


def test_quantize_undoes_the_division_by_255():
    levels = np.arange(256, dtype=np.uint8)
    for dtype in (np.float32, np.float64):
        np.testing.assert_array_equal(quantize((levels / 255.0).astype(dtype)), levels)


@pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf])
def test_quantize_refuses_what_is_no_number(bad):
    with pytest.raises(BadPrediction, match="NaN or infinite"):
        quantize(np.array([0.5, bad]))


def test_quantize_refuses_integers():
    with pytest.raises(BadPrediction, match="uint8"):
        quantize(np.zeros(3, np.uint8))


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
    with pytest.raises(BadPrediction, match="quantize"):
        check_prediction(IMAGE.astype(np.float32), IMAGE)
