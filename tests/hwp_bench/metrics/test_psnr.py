"""PSNR. Oracles: OpenImageIO `compare().PSNR` (1e-5 dB, it works in float32), and by hand."""

from __future__ import annotations

import math

import numpy as np
import OpenImageIO as oiio
import pytest

from hwp_bench.base.errors import EmptyMask, ShapeMismatch
from hwp_bench.metrics.pixels import decibels, squared_error
from hwp_bench.metrics.protocol import PSNR_CAP
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


def test_matches_openimageio_on_the_masked_pixels(pair):
    prediction, target, mask = pair
    expected = oiio_psnr(prediction[mask][:, None] / 255.0, target[mask][:, None] / 255.0)
    found = scores(prediction, target, mask)
    assert found["psnr"] == pytest.approx(expected, abs=1e-5)
    assert found["psnr_edge"] == pytest.approx(expected, abs=1e-5)


def test_full_matches_openimageio_on_the_composites(pair):
    prediction, target, mask = pair
    black = mask[..., None]
    expected = oiio_psnr(prediction / 255.0 * black, target / 255.0 * black)
    found = scores(prediction, target, mask)
    assert found["psnr_full"] == pytest.approx(expected, abs=1e-5)
    assert found["paper_psnr"] == pytest.approx(expected, abs=1e-5)


def test_box_matches_openimageio_on_the_padded_box(pair):
    prediction, target, mask = pair
    mask = mask & (np.indices(mask.shape).sum(axis=0) > 70)
    rows, columns = np.nonzero(mask)
    window = (
        slice(rows.min() + 5, rows.max() + 16),
        slice(columns.min() + 5, columns.max() + 16),
    )
    x, y = (
        np.pad(i / 255.0 * mask[..., None], ((10, 10), (10, 10), (0, 0)))
        for i in (prediction, target)
    )
    expected = oiio_psnr(np.ascontiguousarray(x[window]), np.ascontiguousarray(y[window]))
    assert scores(prediction, target, mask)["psnr_box"] == pytest.approx(expected, abs=1e-5)


@pytest.mark.parametrize(("value", "expected"), [(0.1, 20.0), (0.01, 40.0), (1.0, 0.0)])
def test_constant_images_by_hand(value, expected):
    target = np.zeros((8, 8, 3))
    mask = disc(8, 3)
    error = squared_error(target + value, target)[mask].mean()
    assert decibels(float(error)) == pytest.approx(expected, abs=1e-12)


def test_full_and_box_differ_from_the_hand_by_the_share_of_the_area():
    target = np.zeros((64, 64, 3), np.uint8)
    mask = disc(64, 20)
    found = scores(target + np.uint8(51), target, mask)
    hand = found["psnr"]
    assert hand == pytest.approx(-20 * math.log10(0.2))
    share = mask.sum() / mask.size
    assert found["psnr_full"] == pytest.approx(hand - 10 * math.log10(share))
    in_box = mask.sum() / (40 + 2 * 5) ** 2
    assert found["psnr_box"] == pytest.approx(hand - 10 * math.log10(in_box))


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


def test_refuses_what_does_not_fit(pair):
    prediction, target, mask = pair
    with pytest.raises(ShapeMismatch):
        scores(prediction[1:], target, mask)
    with pytest.raises(ShapeMismatch):
        scores(prediction, target, mask[1:])
    with pytest.raises(EmptyMask):
        scores(prediction, target, np.zeros_like(mask))
