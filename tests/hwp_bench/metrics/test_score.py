"""One frame: against scikit-image on whole images, by arithmetic, and as properties."""

from __future__ import annotations

import math
import random

import cv2
import numpy as np
import OpenImageIO as oiio
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from skimage.metrics import structural_similarity

from hwp_bench.base.errors import (
    BadImage,
    BadPrediction,
    BadResult,
    EmptyMask,
    HwpError,
    ShapeMismatch,
)
from hwp_bench.base.images import as_uint8
from hwp_bench.metrics import HWP_V1, PAPER_WILDGHAND, metric, metric_names, penalty
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
from hwp_bench.metrics.score import (
    CaptureScores,
    ScoredFrame,
    aggregate,
    mean_scores,
    score_frame,
    score_frames,
)


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
    # A half between two 8-bit levels is off by 2^-12 at most, an eighth of a level: nothing moves.
    for kind in (np.float32, np.float16):
        assert score_frame((prediction / 255.0).astype(kind), target, mask) == expected
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
    for dtype in (np.int32, np.complex64, bool):
        with pytest.raises(HwpError):
            score_frame(prediction, target.astype(dtype), mask)
    with pytest.raises(BadImage):
        score_frame(prediction, np.full(target.shape, np.nan, np.float16), mask)
    small = np.zeros((10, 10, 3), np.uint8)
    with pytest.raises(ShapeMismatch, match="window"):
        score_frame(small, small, np.full((10, 10), 255, np.uint8))


def frames(count: int) -> list[ScoredFrame]:
    rng = np.random.default_rng(0)
    mask = np.zeros((40, 44), np.uint8)
    mask[8:30, 10:36] = 255
    made = []
    for index in range(count):
        target = rng.integers(0, 256, (40, 44, 3), dtype=np.uint8)
        prediction = np.clip(target + rng.normal(0, 3 + index, target.shape), 0, 255)
        made.append(ScoredFrame(prediction.astype(np.uint8), target, mask))
    return made


@pytest.mark.parametrize("workers", [1, 2, 5])
def test_order_and_scores_do_not_depend_on_the_workers(workers):
    listed = frames(30)
    expected = [score_frame(f.prediction, f.target, f.mask) for f in listed]
    got = score_frames(iter(listed), workers=workers)
    assert got == expected


def test_a_frame_without_a_prediction_costs_its_penalty_and_no_row():
    listed = frames(3)
    listed[1] = ScoredFrame(None, listed[1].target, listed[1].mask)

    def near(x: np.ndarray, y: np.ndarray) -> float:
        return 0.25

    got = score_frames(listed, workers=2, networks={"alex": near})
    assert got[1] == penalty(["alex"])
    assert [row["lpips_alex"] for row in got] == [0.25, 1.0, 0.25]


def test_a_fault_of_the_data_set_is_raised_not_penalised():
    good = frames(3)
    bad = ScoredFrame(good[0].prediction, good[0].target, good[0].mask[1:])
    with pytest.raises(ShapeMismatch, match="mask"):
        score_frames([*good, bad, *good], workers=2)


def test_a_removed_frame_never_scores_better_than_a_delivered_one():
    """The declared penalties are at the bad end: a noise image gains nothing by failing."""
    rng = np.random.default_rng(0)
    target, mask = frames(1)[0].target, frames(1)[0].mask
    delivered = score_frame(rng.integers(0, 256, target.shape, dtype=np.uint8), target, mask)
    declared = penalty()
    assert delivered["psnr"] > declared["psnr"]
    assert delivered["oriented_distance"] < declared["oriented_distance"]


def textured(shape: tuple[int, int], seed: int) -> np.ndarray:
    return np.random.default_rng(seed).integers(0, 256, (*shape, 3), dtype=np.uint8)


def best(scores: dict[str, float]) -> None:
    """A perfect frame: PSNR at the cap, SSIM 1, distance 0."""
    for name, value in scores.items():
        expected = PSNR_CAP if "psnr" in name else 1.0 if "ssim" in name else 0.0
        assert value == expected, name


@pytest.mark.parametrize("shape", [(11, 4096), (4096, 11), (4096, 12), (16, 4096)])
def test_images_of_4096_pixels_agree_with_other_programs(shape: tuple[int, int]) -> None:
    prediction, target = textured(shape, 0), textured(shape, 1)
    scores = score_frame(prediction, target, np.ones(shape, bool), coverage=True)
    x, y = prediction / 255.0, target / 255.0
    images = [oiio.ImageBuf(image.astype(np.float32)) for image in (x, y)]
    expected = oiio.ImageBufAlgo.compare(*images, 1.0, 1.0).PSNR
    assert scores["psnr"] == pytest.approx(expected, abs=1e-5)
    assert scores["psnr_full"] == pytest.approx(expected, abs=1e-5)
    _, similar = structural_similarity(
        x, y, full=True, gaussian_weights=True, sigma=1.5, use_sample_covariance=False,
        data_range=1.0, channel_axis=2,
    )  # fmt: skip
    inside = similar.mean(2)[5:-5, 5:-5].mean()
    assert scores["ssim_full"] == pytest.approx(inside, abs=1e-10)
    best(score_frame(target, target, np.ones(shape, bool), coverage=True))


@pytest.mark.parametrize("shape", [(1, 1), (1, 64), (64, 1), (10, 4096), (4096, 10)])
def test_an_image_smaller_than_the_window_is_refused_by_name(shape: tuple[int, int]) -> None:
    image = textured(shape, 0)
    with pytest.raises(ShapeMismatch, match="smaller than the window of SSIM"):
        score_frame(image, image, np.ones(shape, bool), coverage=True)


@pytest.mark.parametrize("level", [0, 1, 127, 255])
def test_constant_frames_as_truth_and_entry(level: int) -> None:
    image = np.full((32, 24, 3), level, np.uint8)
    mask = np.zeros((32, 24), bool)
    mask[8:20, 6:18] = True
    best(score_frame(image, image, mask))


def test_memory_layout_changes_no_bit() -> None:
    prediction, target = textured((40, 30), 2), textured((40, 30), 3)
    mask = np.zeros((40, 30), np.uint8)
    mask[6:30, 5:25] = 255
    expected = score_frame(prediction, target, mask)
    wide = np.repeat(prediction, 2, axis=1)[:, ::2]
    given = wide, np.asfortranarray(target), mask[::-1][::-1]
    assert not any(array.flags.c_contiguous for array in given[:2])
    assert score_frame(*given) == expected


def capture(id_, hands, perturbations, scores):
    frames = {index: {"psnr": value} for index, value in enumerate(scores)}
    return CaptureScores(id_, hands, tuple(perturbations), frames)


CAPTURES = [
    capture("a", "right", ["blur", "light"], [10.0, 20.0]),
    capture("b", "both", ["blur"], [30.0, 30.0, 36.0]),
    capture("c", "left", [], [7.0]),
]


def test_by_hand():
    result = aggregate(CAPTURES)
    overall = result.overall
    assert overall.captures == {"a": {"psnr": 15.0}, "b": {"psnr": 32.0}, "c": {"psnr": 7.0}}
    assert overall.perturbations == {"blur": {"psnr": 23.5}, "light": {"psnr": 15.0}}
    assert overall.macro == {"psnr": 19.25}
    assert overall.capture_mean == {"psnr": 18.0}
    assert overall.micro == {"psnr": pytest.approx(133 / 6)}
    assert result.single is not None
    assert result.single.macro == {"psnr": 15.0}
    assert result.single.capture_mean == {"psnr": 11.0}
    assert result.interacting is not None
    assert result.interacting.perturbations == {"blur": {"psnr": 32.0}}


def test_a_clean_capture_has_no_macro_mean_and_no_interacting_half():
    result = aggregate(CAPTURES[2:])
    assert result.overall.macro == {}
    assert result.overall.capture_mean == {"psnr": 7.0}
    assert result.interacting is None


@given(st.lists(st.floats(-1e6, 1e6), min_size=1, max_size=30), st.randoms())
def test_order_changes_no_digit(values, shuffler: random.Random):
    captures = [
        capture(str(k), ("right", "both")[k % 2], ["p" + str(k % 3)], values[k:] + values[:k])
        for k in range(4)
    ]
    shuffled = captures[:]
    shuffler.shuffle(shuffled)
    reordered = []
    for c in shuffled:
        frames = list(c.frames.items())
        shuffler.shuffle(frames)
        reordered.append(CaptureScores(c.id, c.hands, c.perturbations, dict(frames)))
    assert aggregate(captures) == aggregate(reordered)


def test_missing_frames_metrics_and_captures_are_refused():
    with pytest.raises(BadResult, match="no scored frame"):
        aggregate([capture("a", "left", [], [])])
    with pytest.raises(BadResult, match="no capture"):
        aggregate([])
    with pytest.raises(BadResult, match="twice"):
        aggregate([CAPTURES[0], CAPTURES[0]])
    odd = CaptureScores("d", "left", (), {0: {"psnr": 1.0}, 1: {"psnr": 1.0, "ssim": 1.0}})
    with pytest.raises(BadResult, match=r"d: frames\[1\].*ssim"):
        aggregate([odd])


def test_mean_of_nothing_is_nothing():
    assert mean_scores([]) == {}
    # What one row lacks has no mean.
    assert mean_scores([{"a": 1.0, "b": 2.0}, {"a": 3.0}, {"c": 9.0, "a": 5.0}]) == {"a": 3.0}
