"""PSNR. Oracles: OpenImageIO `compare().PSNR` (1e-5 dB, it works in float32), and by hand."""

from __future__ import annotations

import math

import cv2
import numpy as np
import OpenImageIO as oiio
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from skimage.metrics import structural_similarity

from hwp_bench.base.errors import EmptyMask, ShapeMismatch
from hwp_bench.base.images import as_uint8
from hwp_bench.metrics.pixels import decibels, squared_error, ssim_box, ssim_map
from hwp_bench.metrics.protocol import HWP_V1, PAPER_WILDGHAND, PSNR_CAP
from hwp_bench.metrics.score import score_frame


def disc(size: int, radius: float) -> np.ndarray:
    rows, columns = np.mgrid[:size, :size] - (size - 1) / 2
    return rows**2 + columns**2 <= radius**2


def oiio_psnr(x: np.ndarray, y: np.ndarray) -> float:
    x, y = x.astype(np.float32), y.astype(np.float32)
    return oiio.ImageBufAlgo.compare(oiio.ImageBuf(x), oiio.ImageBuf(y), 1.0, 1.0).PSNR


def scores(prediction: np.ndarray, target: np.ndarray, mask: np.ndarray) -> dict[str, float]:
    """Scores on the pixels of a bool mask as they are, without erosion."""
    return score_frame(prediction, target, mask, coverage=True)


@pytest.fixture
def pair():
    rng = np.random.default_rng(3)
    target = rng.integers(0, 256, (40, 50, 3), dtype=np.uint8)
    noise = rng.normal(0, 20, target.shape)
    prediction = np.clip(np.rint(target + noise), 0, 255).astype(np.uint8)
    mask = rng.random((40, 50)) > 0.7
    return prediction, target, mask


def test_matches_openimageio(pair):
    """On the masked pixels, on the composites, and on the padded box."""
    prediction, target, mask = pair
    mask = mask & (np.indices(mask.shape).sum(axis=0) > 70)
    found = scores(prediction, target, mask)
    expected = oiio_psnr(prediction[mask][:, None] / 255.0, target[mask][:, None] / 255.0)
    for name in ("psnr", "psnr_edge"):
        assert found[name] == pytest.approx(expected, abs=1e-5)
    x, y = (image / 255.0 * mask[..., None] for image in (prediction, target))
    for name in ("psnr_full", "paper_psnr"):
        assert found[name] == pytest.approx(oiio_psnr(x, y), abs=1e-5)
    rows, columns = np.nonzero(mask)
    window = slice(rows.min() + 5, rows.max() + 16), slice(columns.min() + 5, columns.max() + 16)
    x, y = (np.pad(image, ((10, 10), (10, 10), (0, 0)))[window].copy() for image in (x, y))
    assert found["psnr_box"] == pytest.approx(oiio_psnr(x, y), abs=1e-5)


@pytest.mark.parametrize(("value", "expected"), [(0.1, 20.0), (0.01, 40.0), (1.0, 0.0)])
def test_constant_images_by_hand(value, expected):
    target = np.zeros((8, 8, 3))
    mask = disc(8, 3)
    error = squared_error(target + value, target)[mask].mean()
    assert decibels(float(error)) == pytest.approx(expected, abs=1e-12)


def test_identical_images_score_the_cap_and_nothing_scores_more(pair):
    _, target, mask = pair
    assert scores(target, target, mask)["psnr"] == PSNR_CAP
    image = target / 255.0
    assert decibels(float(squared_error(image + 1e-9, image).mean())) == PSNR_CAP
    assert decibels(1e-3, cap=20.0) == 20.0


def test_one_level_in_one_pixel_of_a_hand_of_4096_stays_below_the_cap():
    target = np.zeros((64, 64, 3), np.uint8)
    prediction = target.copy()
    prediction[10, 10, 1] = 1
    score = scores(prediction, target, np.ones((64, 64), bool))["psnr"]
    assert score == pytest.approx(10 * math.log10(255**2 * 64 * 64 * 3))
    assert score < PSNR_CAP


GAUSSIAN = {
    "gaussian_weights": True,
    "sigma": 1.5,
    "use_sample_covariance": False,
    "data_range": 1.0,
    "channel_axis": 2,
}
#: scikit-image's defaults, with the data range that it once took for float images.
RELEASED = {"data_range": 2.0, "channel_axis": 2}


@pytest.fixture
def ssim_pair():
    """Two images of 8-bit values in [0, 1], and a mask."""
    rng = np.random.default_rng(5)
    smooth = cv2.GaussianBlur(rng.random((90, 80, 3)), (0, 0), 3.0)
    target = np.clip((smooth - 0.5) * 4 + 0.5, 0, 1)
    prediction = np.clip(target + rng.normal(0, 0.05, target.shape), 0, 1)
    mask = np.zeros((90, 80), bool)
    mask[20:70, 15:60] = smooth[20:70, 15:60, 0] > 0.48
    return as_uint8(prediction) / 255.0, as_uint8(target) / 255.0, mask


def test_map_matches_scikit_image(ssim_pair):
    x, y, _ = ssim_pair
    _, expected = structural_similarity(x, y, full=True, **GAUSSIAN)
    np.testing.assert_allclose(ssim_map(x, y), expected.mean(2)[5:-5, 5:-5], atol=1e-10)
    _, expected = structural_similarity(x, y, full=True, **RELEASED)
    got = ssim_map(x, y, PAPER_WILDGHAND.ssim)
    np.testing.assert_allclose(got, expected.mean(2)[3:-3, 3:-3], atol=1e-10)


def test_map_matches_opencv_quality(ssim_pair):
    x, y = (np.rint(image * 255).astype(np.uint8) for image in ssim_pair[:2])
    _, expected = cv2.quality.QualitySSIM_compute(x, y)
    expected = np.asarray(expected)[5:-5, 5:-5, :3].mean(axis=2)
    np.testing.assert_allclose(ssim_map(x / 255.0, y / 255.0), expected, atol=1e-4)


@pytest.mark.parametrize(("a", "b"), [(0.2, 0.6), (0.0, 1.0), (0.5, 0.5)])
def test_ssim_of_constant_images_by_hand(a, b):
    c1 = 0.01**2
    expected = (2 * a * b + c1) / (a * a + b * b + c1)
    image = np.ones((20, 20, 3))
    np.testing.assert_allclose(ssim_map(a * image, b * image), expected, rtol=1e-12)


def test_a_hand_at_the_frame_scores_all_its_pixels():
    rng = np.random.default_rng(0)
    x, y = rng.integers(0, 256, (2, 30, 30, 3)) / 255.0
    mask = np.zeros((30, 30), bool)
    mask[:12, 20:] = True
    images = [as_uint8(image) for image in (x, y)]
    padded = [np.pad(image, ((9, 9), (9, 9), (0, 0))) for image in images]
    expected = scores(*padded, np.pad(mask, 9))["ssim"]
    assert scores(*images, mask)["ssim"] == pytest.approx(expected, abs=1e-14)


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
    assert ssim_box(x, x, mask) == 1.0
    assert -1.0 <= ssim_box(x, y, mask) <= 1.0
    assert ssim_box(x, y, mask) == pytest.approx(ssim_box(y, x, mask), abs=1e-12)


def test_ssim_refuses_what_does_not_fit(ssim_pair):
    x, y, mask = ssim_pair
    with pytest.raises(ShapeMismatch, match="smaller than the window"):
        ssim_map(x[:10], y[:10], HWP_V1.ssim)
    with pytest.raises(EmptyMask):
        ssim_box(x, y, np.zeros_like(mask))
