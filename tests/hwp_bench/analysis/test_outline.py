"""What is drawn outside of the hand. Oracle: drawings whose numbers follow by hand, exactly."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from hwp_bench.analysis.outline import LIT, outline_scores, spread_outwards
from hwp_bench.base.errors import ShapeMismatch
from hwp_bench.metrics.protocol import PSNR_CAP
from hwp_bench.metrics.score import score_frame

SIZE = 64


def square(edge: int, color: tuple[int, int, int] = (200, 140, 110)) -> np.ndarray:
    """A hand of one colour over black: a square in the middle of the frame."""
    image = np.zeros((SIZE, SIZE, 3), np.uint8)
    first = (SIZE - edge) // 2
    image[first : first + edge, first : first + edge] = color
    return image


def coverage_of(image: np.ndarray) -> np.ndarray:
    """255 where the hand is; no pixel is mixed."""
    return np.where(image.max(axis=2) > 0, 255, 0).astype(np.uint8)


def test_the_truth_draws_nothing_outside() -> None:
    truth = square(30)
    found = outline_scores(truth, truth, coverage_of(truth), coverage=True)
    assert found is not None
    assert (found.psnr, found.drawn_outside, found.psnr_with_outside) == (PSNR_CAP, 0.0, PSNR_CAP)
    assert found.psnr_spread == PSNR_CAP


def test_a_hand_that_is_too_large_pays_for_what_is_outside() -> None:
    truth, large = square(30), square(40)
    found = outline_scores(large, truth, coverage_of(truth), coverage=True)
    assert found is not None
    assert found.psnr == PSNR_CAP
    ring = (40**2 - 30**2) / 30**2
    assert found.drawn_outside == pytest.approx(ring, abs=1e-12)
    power = np.mean((np.array([200, 140, 110]) / 255.0) ** 2)
    assert found.psnr_with_outside == pytest.approx(-10 * np.log10(ring * power), abs=1e-9)


def test_a_hand_that_is_too_small_gains_by_spreading() -> None:
    truth, small = square(30), square(26)
    found = outline_scores(small, truth, coverage_of(truth), coverage=True)
    assert found is not None
    power = np.mean((np.array([200, 140, 110]) / 255.0) ** 2)
    missing = (30**2 - 26**2) / 30**2
    assert found.psnr == pytest.approx(-10 * np.log10(missing * power), abs=1e-9)
    assert found.psnr_with_outside == found.psnr
    assert found.psnr_spread == PSNR_CAP


@given(seed=st.integers(0, 2**32 - 1), exact=st.booleans())
def test_the_psnr_is_the_headline_s_and_the_outside_only_adds_error(seed: int, exact: bool) -> None:
    random = np.random.default_rng(seed)
    mask = random.choice(np.array([0, 90, 200, 255], np.uint8), (SIZE, SIZE))
    mask[20:40, 20:40] = 255
    prediction, target = random.integers(0, 256, (2, SIZE, SIZE, 3), dtype=np.uint8)
    found = outline_scores(prediction, target, mask, coverage=exact)
    assert found is not None
    headline = score_frame(prediction, target, mask, coverage=exact)["psnr"]
    assert found.psnr == pytest.approx(headline, abs=1e-9)
    assert found.psnr_with_outside <= found.psnr + 1e-12


def test_the_uncertain_border_of_an_estimated_mask_is_not_outside() -> None:
    truth = square(30)
    mask = coverage_of(truth)
    near = outline_scores(square(34), truth, mask)
    far = outline_scores(square(36), truth, mask)
    assert near is not None
    assert far is not None
    assert near.drawn_outside == 0.0
    assert far.drawn_outside > 0.0


def test_a_rim_that_is_mixed_with_black_is_not_what_spreads() -> None:
    image = square(30)
    rim = square(30).max(axis=2) > 0
    rim[18:46, 18:46] = False
    image[rim] //= 4
    spread = spread_outwards(image, image.max(axis=2) > LIT)
    assert (spread == np.array([200, 140, 110])).all()


def test_a_black_frame_spreads_nothing() -> None:
    black, truth = np.zeros((SIZE, SIZE, 3), np.uint8), square(30)
    found = outline_scores(black, truth, coverage_of(truth), coverage=True)
    assert found is not None
    assert found.psnr_spread == found.psnr == found.psnr_with_outside


def test_a_frame_without_scored_pixels_and_one_of_another_size() -> None:
    truth = square(30)
    nothing = np.zeros((SIZE, SIZE), np.uint8)
    assert outline_scores(truth, truth, nothing, coverage=True) is None
    with pytest.raises(ShapeMismatch):
        outline_scores(truth[:-1], truth, coverage_of(truth), coverage=True)
