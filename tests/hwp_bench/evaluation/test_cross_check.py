"""scikit-image's PSNR and SSIM of scored pixels. Oracle: the toolkit's own scores, to 1e-9."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from hwp_bench.evaluation.verify import CROSS_SAMPLE, reference_scores, sample_frames
from hwp_bench.metrics import HWP_V1
from hwp_bench.metrics.score import score_frame


@given(st.integers(0, 2**32 - 1), st.integers(12, 60), st.integers(12, 60), st.booleans())
@settings(max_examples=40, deadline=None)
def test_both_agree_wherever_the_hand_is(seed: int, height: int, width: int, exact: bool) -> None:
    rng = np.random.default_rng(seed)
    target, prediction = rng.integers(0, 256, (2, height, width, 3), dtype=np.uint8)
    mask = np.zeros((height, width), np.uint8)
    top, left = rng.integers(0, height - 3), rng.integers(0, width - 3)
    mask[top : top + rng.integers(3, 30), left : left + rng.integers(3, 30)] = 255
    mask[rng.random(mask.shape) < 0.02] = 127 if exact else 0
    mask[top : top + 3, left : left + 3] = 255
    expected = score_frame(prediction, target, mask, (HWP_V1,), coverage=exact)
    found = reference_scores(prediction, target, mask, coverage=exact)
    assert found == pytest.approx({name: expected[name] for name in found}, abs=1e-9)


def test_equal_images_have_the_cap_and_one() -> None:
    image = np.random.default_rng(0).integers(0, 256, (20, 30, 3), dtype=np.uint8)
    mask = np.full((20, 30), 255, np.uint8)
    scores = reference_scores(image, image, mask, coverage=True)
    assert scores == {"psnr": 100.0, "ssim": pytest.approx(1.0, abs=1e-12)}


def test_a_sample_is_even_and_bounded() -> None:
    assert sample_frames(1) == [0]
    assert sample_frames(3) == [0, 1, 2]
    assert sample_frames(10) == [0, 3, 6, 9]
    assert len(sample_frames(1000)) == CROSS_SAMPLE
