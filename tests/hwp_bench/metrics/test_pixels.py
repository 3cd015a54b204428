"""The images that scoring accepts."""

from __future__ import annotations

import numpy as np
import pytest

from hwp_bench.base.errors import BadImage, BadPrediction, ShapeMismatch
from hwp_bench.metrics.pixels import check_prediction, check_truth

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
