"""One frame: against scikit-image on whole images, by arithmetic, and as properties."""

from __future__ import annotations

import math

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from skimage.metrics import structural_similarity

from hwp_bench.base.errors import BadImage, BadPrediction, EmptyMask, ShapeMismatch
from hwp_bench.base.images import as_uint8
from hwp_bench.metrics import HWP_V1, PAPER_WILDGHAND, metric, metric_names
from hwp_bench.metrics.pixels import (
    bounding_box,
    crop,
    decibels,
    hand_pixels,
    oriented_distance,
    scored_pixels,
    squared_error,
    ssim_box,
    ssim_map,
)
from hwp_bench.metrics.protocol import PSNR_CAP
from hwp_bench.metrics.score import score_frame


def blob_mask(rng: np.random.Generator, height: int, width: int) -> np.ndarray:
    """A blobby mask with at least one scored pixel; may touch the frame."""
    smooth = cv2.GaussianBlur(rng.random((height, width)), (0, 0), 3.0)
    mask = (smooth > np.quantile(smooth, rng.uniform(0.1, 0.9))).astype(np.uint8) * 255
    row, column = int(rng.integers(1, height - 1)), int(rng.integers(1, width - 1))
    mask[row - 1 : row + 2, column - 1 : column + 2] = 255
    return mask


def random_frame(seed: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    rng = np.random.default_rng(seed)
    height, width = (int(side) for side in rng.integers(12, 70, 2))
    target = rng.integers(0, 256, (height, width, 3), dtype=np.uint8)
    noise = rng.normal(0, rng.uniform(1, 60), target.shape)
    prediction = np.clip(np.rint(target + noise), 0, 255).astype(np.uint8)
    return prediction, target, blob_mask(rng, height, width)


seeds = st.integers(0, 2**32 - 1)


def plain_psnr(x: np.ndarray, y: np.ndarray) -> float:
    """PSNR of all pixels of two float images."""
    error = float(np.mean((x - y) ** 2))
    return PSNR_CAP if error == 0 else min(PSNR_CAP, -10 * math.log10(error))


def plain_ssim(x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """scikit-image's SSIM of every pixel of two float images, window Gaussian 11/1.5."""
    _, similarity = structural_similarity(
        x,
        y,
        full=True,
        channel_axis=2,
        gaussian_weights=True,
        sigma=1.5,
        use_sample_covariance=False,
        data_range=1.0,
    )
    return similarity.mean(axis=2)


@given(seeds, st.booleans())
@settings(max_examples=40, deadline=None)
def test_the_single_pass_equals_whole_images(seed, coverage):
    """Oracle: numpy and scikit-image on the whole frame; shared work may not change a score."""
    prediction, target, mask = random_frame(seed)
    if coverage:
        mask[::3] = np.minimum(mask[::3], 200)
        mask[mask.shape[0] // 2, mask.shape[1] // 2] = 255
    x, y = prediction / 255.0, target / 255.0
    region, hand = scored_pixels(mask, erosion=1, coverage=coverage), hand_pixels(mask)
    on_region = [image * region[..., None] for image in (x, y)]
    on_hand = [image * hand[..., None] for image in (x, y)]
    padded = [np.pad(image, ((5, 5), (5, 5), (0, 0))) for image in on_region]
    box = bounding_box(region).grown(HWP_V1.box_padding)
    tight = bounding_box(hand).at_least(PAPER_WILDGHAND.smallest_box)
    released = [crop(image, tight) for image in on_hand]
    expected = {
        "psnr": plain_psnr(x[region], y[region]),
        "psnr_full": plain_psnr(*on_region),
        "psnr_box": plain_psnr(*(crop(image, box) for image in on_region)),
        "psnr_edge": plain_psnr(x[hand], y[hand]),
        "ssim": plain_ssim(*padded)[5:-5, 5:-5][region].mean(),
        "ssim_full": plain_ssim(*on_region)[5:-5, 5:-5].mean(),
        "oriented_distance": oriented_distance(x, y, region),
        "paper_psnr": plain_psnr(*on_hand),
        "paper_ssim": structural_similarity(*released, channel_axis=2, data_range=2.0),
    }
    scores = score_frame(prediction, target, mask, coverage=coverage)
    assert set(scores) == set(metric_names())
    assert scores == pytest.approx(expected, abs=1e-10)


@given(seeds)
@settings(max_examples=10, deadline=None)
def test_float_images_score_as_the_eight_bits_that_they_become(seed):
    prediction, target, mask = random_frame(seed)
    expected = score_frame(prediction, target, mask)
    assert score_frame(prediction / 255.0, target / 255.0, mask) == expected
    assert score_frame((prediction / 255.0).astype(np.float32), target, mask) == expected
    # A rendering that overshoots is clipped, as it is when it is written.
    bright = np.where(prediction == 255, 1.3, prediction / 255.0)
    assert score_frame(bright, target, mask) == expected


@given(seeds)
@settings(max_examples=25, deadline=None)
def test_the_truth_scores_perfectly(seed):
    _, target, mask = random_frame(seed)
    for name, value in score_frame(target.copy(), target, mask).items():
        assert value == metric(name).perfect, name


@given(seeds)
@settings(max_examples=25, deadline=None)
def test_every_score_stays_in_its_range_and_swapping_the_images_changes_none(seed):
    prediction, target, mask = random_frame(seed)
    scores = score_frame(prediction, target, mask)
    for name, value in scores.items():
        low, high = metric(name).range
        assert low <= value <= high, name
    assert scores == pytest.approx(score_frame(target, prediction, mask), rel=1e-6)


@given(seeds)
@settings(max_examples=25, deadline=None)
def test_pixels_outside_the_mask_never_matter_in_either_image(seed):
    prediction, target, mask = random_frame(seed)
    rng = np.random.default_rng(seed + 1)
    outside = mask <= 127
    other_prediction, other_target = prediction.copy(), target.copy()
    for image in (other_prediction, other_target):
        image[outside] = rng.integers(0, 256, (int(outside.sum()), 3))
    assert score_frame(prediction, target, mask) == score_frame(
        other_prediction, other_target, mask
    )


@given(seeds)
@settings(max_examples=20, deadline=None)
def test_more_noise_is_worse_in_every_metric(seed):
    rng = np.random.default_rng(seed)
    rows, columns = np.mgrid[:64, :64]
    ramp = 120 + 40 * np.sin(rows / rng.uniform(2, 6)) + 30 * np.cos(columns / rng.uniform(2, 6))
    target = np.rint(ramp[..., None] * [1.0, 0.8, 0.7]).astype(np.uint8)
    noise = rng.normal(0, 1, target.shape)
    mask = blob_mask(rng, 64, 64)
    mask[20:44, 20:44] = 255
    weak, strong = (
        score_frame(np.clip(np.rint(target + s * noise), 0, 255).astype(np.uint8), target, mask)
        for s in (6.0, 18.0)
    )
    for name in weak:
        better = weak[name] > strong[name]
        assert better == metric(name).higher_is_better, name


def test_black_images_score_what_arithmetic_says():
    """Constant target c on a square of the frame: every number but the distance by hand."""
    c = 102 / 255.0
    target = np.full((64, 64, 3), 102, np.uint8)
    mask = np.zeros((64, 64), np.uint8)
    mask[16:48, 16:48] = 255
    scores = score_frame(np.zeros_like(target), target, mask)
    hand = -20 * math.log10(c)
    assert scores["psnr"] == pytest.approx(hand)
    assert scores["psnr_edge"] == pytest.approx(hand)
    assert scores["psnr_full"] == pytest.approx(hand + 10 * math.log10(64**2 / 30**2))
    assert scores["psnr_box"] == pytest.approx(hand + 10 * math.log10(40**2 / 30**2))
    assert scores["paper_psnr"] == pytest.approx(hand + 10 * math.log10(64**2 / 32**2))

    # SSIM against black is C1 C2 / ((m^2 + C1)(v + C2)) with the window's mean and variance;
    # for a square of constant colour both follow from the window's weight w inside it.
    taps = np.exp(-0.5 * (np.arange(-5, 6) / 1.5) ** 2)
    inside = np.convolve(np.pad(np.ones(30), 5), taps / taps.sum(), "valid")
    weight = np.outer(inside, inside)
    variance = c * c * weight * (1 - weight)
    expected = 1e-4 * 9e-4 / (((c * weight) ** 2 + 1e-4) * (variance + 9e-4))
    assert scores["ssim"] == pytest.approx(expected.mean(), abs=1e-12)
    # Inside the tight box nothing varies, and with a data range of 2 C1 is 4e-4.
    assert scores["paper_ssim"] == pytest.approx(4e-4 / (c * c + 4e-4), abs=1e-12)


def test_the_textured_disc_shows_why_conventions_matter():
    """A disc that fills 10 % of a black frame: the order and the gaps that the protocol states."""
    size = 256
    rows, columns = np.mgrid[:size, :size] - (size - 1) / 2
    mask = rows**2 + columns**2 <= 0.1 * size**2 / np.pi
    rng = np.random.default_rng(1)
    texture = cv2.GaussianBlur(rng.random((size, size, 3)), (0, 0), 2.0)
    target = np.clip(0.5 + 2.5 * (texture - 0.5), 0, 1) * mask[..., None]
    prediction = np.clip(target + 0.078 * rng.normal(size=target.shape), 0, 1) * mask[..., None]

    scores = score_frame(prediction, target, mask, coverage=True)
    hand, full = scores["psnr"], scores["psnr_full"]
    x, y = as_uint8(prediction) / 255.0, as_uint8(target) / 255.0
    box = decibels(float(squared_error(x, y).sum()) / bounding_box(mask).area)
    assert full - hand == pytest.approx(10.0, abs=0.02)
    assert box - hand == pytest.approx(-10 * math.log10(math.pi / 4), abs=0.1)

    full_uniform = float(ssim_map(x, y, PAPER_WILDGHAND.ssim).mean())
    full_gaussian, hand_gaussian = scores["ssim_full"], scores["ssim"]
    box_uniform = ssim_box(x, y, mask)
    assert full_uniform > full_gaussian > box_uniform > hand_gaussian
    assert full_gaussian - hand_gaussian > 0.2


def test_one_protocol_gives_its_own_metrics_only():
    prediction, target, mask = random_frame(0)
    both = score_frame(prediction, target, mask)
    for chosen in (HWP_V1, PAPER_WILDGHAND):
        scores = score_frame(prediction, target, mask, (chosen,))
        assert set(scores) == set(metric_names((chosen,)))
        assert scores == {name: both[name] for name in scores}


def test_networks_see_the_black_box_in_range_and_at_least_64_pixels():
    prediction, target, mask = random_frame(7)
    seen = []

    def network(x: np.ndarray, y: np.ndarray) -> float:
        seen.append((x, y))
        return 0.25

    scores = score_frame(prediction, target, mask, networks={"alex": network})
    assert set(scores) == set(metric_names(networks=["alex"]))
    assert scores["lpips_alex"] == scores["paper_lpips"] == 0.25
    for x, y in seen:
        assert x.shape == y.shape
        assert min(x.shape[:2]) >= 64
        assert 0.0 <= x.min() <= x.max() <= 1.0
        assert not x[0, 0].any()


def test_an_empty_region_is_the_same_error_for_every_prediction():
    _, target, mask = random_frame(2)
    thin = np.zeros_like(mask)
    thin[4:6] = 255
    for prediction in (target, target[1:]):
        with pytest.raises(EmptyMask):
            score_frame(prediction, target, thin)
    assert score_frame(target, target, thin, (PAPER_WILDGHAND,))["paper_ssim"] == 1.0


def test_what_does_not_fit_is_refused_by_name():
    prediction, target, mask = random_frame(3)
    with pytest.raises(ShapeMismatch, match="prediction"):
        score_frame(prediction[1:], target, mask)
    with pytest.raises(ShapeMismatch, match="mask"):
        score_frame(prediction, target, mask[1:])
    with pytest.raises(BadPrediction, match="int16"):
        score_frame(prediction.astype(np.int16), target, mask)
    with pytest.raises(BadPrediction, match=r"prediction: .* up to 255\. .*divide"):
        score_frame(prediction.astype(np.float32) + 255 - prediction.max(), target, mask)
    with pytest.raises(BadPrediction, match=r"prediction: .*NaN"):
        score_frame(np.full(target.shape, np.nan), target, mask)
    with pytest.raises(BadImage, match="target"):
        score_frame(prediction, target.astype(np.int16), mask)
    with pytest.raises(BadImage, match=r"target: .*divide"):
        score_frame(prediction, target.astype(np.float64), mask)
    small = np.zeros((10, 10, 3), np.uint8)
    with pytest.raises(ShapeMismatch, match="window"):
        score_frame(small, small, np.full((10, 10), 255, np.uint8))
