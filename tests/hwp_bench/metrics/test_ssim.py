"""SSIM. Oracles: scikit-image with the same window (1e-10), cv2.quality (1e-4), by hand."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from skimage.metrics import structural_similarity

from hwp_bench.base.errors import EmptyMask, ShapeMismatch
from hwp_bench.base.images import as_uint8
from hwp_bench.metrics.pixels import bounding_box, ssim_box, ssim_map
from hwp_bench.metrics.protocol import HWP_V1, PAPER_WILDGHAND
from hwp_bench.metrics.score import score_frame

GAUSSIAN = {
    "gaussian_weights": True,
    "sigma": 1.5,
    "use_sample_covariance": False,
    "data_range": 1.0,
    "channel_axis": 2,
}
#: scikit-image's defaults, with the data range that it once took for float images.
RELEASED = {"data_range": 2.0, "channel_axis": 2}


def score(x: np.ndarray, y: np.ndarray, mask: np.ndarray) -> dict[str, float]:
    """Scores of two images of 8-bit values in [0, 1] on the pixels of `mask`, without erosion."""
    return score_frame(as_uint8(x), as_uint8(y), mask, (HWP_V1,), coverage=True)


@pytest.fixture
def pair():
    """Two images of 8-bit values in [0, 1], and a mask."""
    rng = np.random.default_rng(5)
    smooth = cv2.GaussianBlur(rng.random((90, 80, 3)), (0, 0), 3.0)
    target = np.clip((smooth - 0.5) * 4 + 0.5, 0, 1)
    prediction = np.clip(target + rng.normal(0, 0.05, target.shape), 0, 1)
    mask = np.zeros((90, 80), bool)
    mask[20:70, 15:60] = smooth[20:70, 15:60, 0] > 0.48
    return as_uint8(prediction) / 255.0, as_uint8(target) / 255.0, mask


def test_map_matches_scikit_image(pair):
    x, y, _ = pair
    _, expected = structural_similarity(x, y, full=True, **GAUSSIAN)
    np.testing.assert_allclose(ssim_map(x, y), expected.mean(2)[5:-5, 5:-5], atol=1e-10)
    _, expected = structural_similarity(x, y, full=True, **RELEASED)
    got = ssim_map(x, y, PAPER_WILDGHAND.ssim)
    np.testing.assert_allclose(got, expected.mean(2)[3:-3, 3:-3], atol=1e-10)


def test_hand_score_matches_scikit_image_at_the_scored_pixels(pair):
    x, y, mask = pair
    black = mask[..., None]
    _, expected = structural_similarity(x * black, y * black, full=True, **GAUSSIAN)
    assert score(x, y, mask)["ssim"] == pytest.approx(expected.mean(2)[mask].mean(), abs=1e-10)


def test_full_score_matches_scikit_image(pair):
    x, y, mask = pair
    black = mask[..., None]
    expected = structural_similarity(x * black, y * black, **GAUSSIAN)
    assert score(x, y, mask)["ssim_full"] == pytest.approx(expected, abs=1e-10)


def test_released_score_matches_scikit_image_on_the_box(pair):
    x, y, mask = pair
    box = bounding_box(mask)
    window = (slice(box.top, box.bottom), slice(box.left, box.right))
    black = mask[..., None]
    expected = structural_similarity((x * black)[window], (y * black)[window], **RELEASED)
    assert ssim_box(x, y, mask) == pytest.approx(expected, abs=1e-10)


def test_map_matches_opencv_quality(pair):
    x, y = (np.rint(image * 255).astype(np.uint8) for image in pair[:2])
    _, expected = cv2.quality.QualitySSIM_compute(x, y)
    expected = np.asarray(expected)[5:-5, 5:-5, :3].mean(axis=2)
    np.testing.assert_allclose(ssim_map(x / 255.0, y / 255.0), expected, atol=1e-4)


@pytest.mark.parametrize(("a", "b"), [(0.2, 0.6), (0.0, 1.0), (0.5, 0.5)])
def test_constant_images_by_hand(a, b):
    c1 = 0.01**2
    expected = (2 * a * b + c1) / (a * a + b * b + c1)
    image = np.ones((20, 20, 3))
    np.testing.assert_allclose(ssim_map(a * image, b * image), expected, rtol=1e-12)


def test_a_hand_at_the_frame_scores_all_its_pixels():
    rng = np.random.default_rng(0)
    x, y = rng.integers(0, 256, (2, 30, 30, 3)) / 255.0
    mask = np.zeros((30, 30), bool)
    mask[:12, 20:] = True
    padded = [np.pad(i, ((9, 9), (9, 9), (0, 0))) for i in (x, y)]
    expected = score(*padded, np.pad(mask, 9))["ssim"]
    assert score(x, y, mask)["ssim"] == pytest.approx(expected, abs=1e-14)


def test_a_box_smaller_than_the_window_is_grown():
    rng = np.random.default_rng(0)
    x, y = rng.random((2, 30, 30, 3))
    mask = np.zeros((30, 30), bool)
    mask[10, 10:12] = True
    assert -1.0 <= ssim_box(x, y, mask) < 1.0


@given(st.integers(0, 2**32 - 1), st.integers(1, 40), st.integers(1, 40))
@settings(max_examples=40, deadline=None)
def test_identical_images_score_exactly_one_and_none_leaves_the_range(seed, height, width):
    rng = np.random.default_rng(seed)
    levels = int(rng.integers(1, 256))
    x, y = rng.integers(0, levels + 1, (2, height, width, 3)) / 255.0
    mask = rng.random((height, width)) > rng.random()
    mask[0, 0] = True
    formulas = [ssim_box]
    if min(height, width) >= HWP_V1.ssim.size:
        formulas.append(lambda x, y, mask: score(x, y, mask)["ssim"])
    for formula in formulas:
        assert formula(x, x, mask) == 1.0
        assert -1.0 <= formula(x, y, mask) <= 1.0
        assert formula(x, y, mask) == pytest.approx(formula(y, x, mask), abs=1e-12)


def test_refuses_what_does_not_fit(pair):
    x, y, mask = pair
    with pytest.raises(ShapeMismatch):
        ssim_box(x, y[1:], mask)
    with pytest.raises(ShapeMismatch, match="smaller than the window"):
        ssim_map(x[:10], y[:10], HWP_V1.ssim)
    with pytest.raises(EmptyMask):
        ssim_box(x, y, np.zeros_like(mask))
    with pytest.raises(EmptyMask):
        score(x, y, np.zeros_like(mask))
