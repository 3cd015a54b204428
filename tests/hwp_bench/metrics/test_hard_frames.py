"""Frames at the limits, through every metric but LPIPS.

Oracles: OpenImageIO's PSNR (1e-5 dB), scikit-image's SSIM (1e-10), the truth as an entry, by hand,
the same frame in another memory layout (the same bits).
"""

from __future__ import annotations

import numpy as np
import OpenImageIO as oiio
import pytest
from skimage.metrics import structural_similarity

from hwp_bench.base.errors import BadImage, HwpError, ShapeMismatch
from hwp_bench.metrics.protocol import PSNR_CAP
from hwp_bench.metrics.score import Frame, score_frame, score_frames


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


@pytest.mark.parametrize("level", [1, 51, 255])
def test_a_black_video_against_a_constant_one(level: int) -> None:
    black = np.zeros((32, 24, 3), np.uint8)
    scores = score_frame(black + np.uint8(level), black, np.ones((32, 24), bool), coverage=True)
    # Variances are 0, so that only SSIM's luminance term with C1 = 0.01^2 is left.
    share = level / 255.0
    assert scores["psnr"] == pytest.approx(-20.0 * np.log10(share), abs=1e-9)
    inner = 1e-4 / (share**2 + 1e-4)
    assert scores["ssim_full"] == pytest.approx(inner, abs=1e-9)
    assert all(np.isfinite(value) for value in scores.values())


def test_memory_layout_changes_no_bit() -> None:
    prediction, target = textured((40, 30), 2), textured((40, 30), 3)
    mask = np.zeros((40, 30), np.uint8)
    mask[6:30, 5:25] = 255
    expected = score_frame(prediction, target, mask)
    wide = np.repeat(prediction, 2, axis=1)[:, ::2]
    given = wide, np.asfortranarray(target), mask[::-1][::-1]
    assert not any(array.flags.c_contiguous for array in given[:2])
    assert score_frame(*given) == expected


def test_half_precision_scores_as_the_eight_bits_that_it_rounds_to() -> None:
    target = textured((40, 30), 4)
    mask = np.ones((40, 30), bool)
    # A half between two 8-bit levels is off by 2^-12 at most, an eighth of a level: nothing moves.
    best(score_frame((target / 255.0).astype(np.float16), target, mask, coverage=True))


def test_2000_frames_are_read_as_they_are_scored() -> None:
    """At no time more frames are alive than are read ahead."""
    alive, most = 0, 0

    class Counted(np.ndarray):
        def __del__(self) -> None:
            nonlocal alive
            if self.base is None:
                alive -= 1

    image = textured((16, 16), 5)
    mask = np.ones((16, 16), bool)

    def read() -> Frame:
        nonlocal alive, most
        own = np.ndarray.__new__(Counted, image.shape, np.uint8)
        own[:] = image
        alive += 1
        most = max(most, alive)
        return Frame(image, own, mask, coverage=True)

    done = sum(score.failure is None for score in score_frames([read] * 2000, workers=1))
    assert done == 2000
    assert most <= 3


def test_numbers_that_no_image_has_are_refused() -> None:
    image, mask = textured((16, 16), 6), np.ones((16, 16), bool)
    for dtype in (np.int32, np.complex64, bool):
        with pytest.raises(HwpError):
            score_frame(image, image.astype(dtype), mask)
    with pytest.raises(BadImage):
        score_frame(image, np.full(image.shape, np.nan, np.float16), mask)
