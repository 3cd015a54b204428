"""Who is an inlier. Oracles: numpy's quantiles, the rules in loops, the schedule by hand."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from trimmed_fit.method import BINS, ErrorHistogram, chance_of_all, find_inliers, pixel_errors


@given(
    errors=hnp.arrays(np.float64, st.integers(1, 200), elements=st.floats(0.0, 0.999)),
    share=st.floats(0.01, 1.0),
)
def test_the_quantile_is_numpy_s_to_a_bin(errors: np.ndarray, share: float) -> None:
    """Tolerance: one bin of 1e-4 and the rounding at its edge."""
    histogram = ErrorHistogram(1.0, torch.device("cpu"))
    histogram.add(torch.from_numpy(errors))
    expected = np.quantile(errors, share, method="inverted_cdf")
    assert histogram.quantile(share) == pytest.approx(expected, abs=1.0 / BINS + 1e-9)
    assert histogram.quantile(share) >= expected - 1e-9


def test_old_errors_are_forgotten() -> None:
    """Two batches of 100 at 0.2 and of 100 at 0.6: the first counts 0.25 by then."""
    histogram = ErrorHistogram(0.5, torch.device("cpu"))
    for value in (0.2, 0.6, 0.6):
        histogram.add(torch.full((100,), value))
    # 25 of 175 are at 0.2.
    assert histogram.quantile(0.14) == pytest.approx(0.2, abs=2.0 / BINS)
    assert histogram.quantile(0.15) == pytest.approx(0.6, abs=2.0 / BINS)


def test_at_first_all_are_inliers_and_errors_above_one_are_counted() -> None:
    histogram = ErrorHistogram(0.95, torch.device("cpu"))
    assert histogram.quantile(0.5) == 1.0
    histogram.add(torch.tensor([3.0, 0.1]))
    assert histogram.quantile(1.0) == 1.0


def slow_inliers(
    errors: np.ndarray, hand: np.ndarray, threshold: float, box: bool, patch: bool
) -> np.ndarray:
    """The rules pixel by pixel on one image."""
    below = (errors < threshold) & hand

    def mostly(top: int, left: int, edge: int) -> bool:
        rows, columns = slice(max(top, 0), top + edge), slice(max(left, 0), left + edge)
        count = hand[rows, columns].sum()
        return bool(count) and below[rows, columns].sum() / count > 0.5

    found = np.ones_like(hand)
    for y, x in zip(*np.nonzero(hand), strict=True):
        found[y, x] = (
            below[y, x]
            or (box and mostly(y - 1, x - 1, 3))
            or (patch and mostly(y // 8 * 8 - 4, x // 8 * 8 - 4, 16))
        )
    return found


@pytest.mark.parametrize("box", [False, True])
@pytest.mark.parametrize("patch", [False, True])
def test_the_rules_are_those_of_a_loop(box: bool, patch: bool) -> None:
    random = np.random.default_rng(4)
    errors = random.random((3, 21, 34)) ** 2
    # Blobs of large errors, so that each rule decides somewhere.
    errors[:, 4:12, 6:20] += 0.5
    hand = random.random(errors.shape) < 0.8
    hand[:, :, 28:] = False
    found = find_inliers(
        torch.from_numpy(errors), torch.from_numpy(hand), 0.3, box=box, patch=patch
    ).numpy()
    for image in range(3):
        expected = slow_inliers(errors[image], hand[image], 0.3, box, patch)
        np.testing.assert_array_equal(found[image], expected)
    assert found[~hand].all()
    assert 0.1 < found[hand].mean() < 0.95


def test_a_block_in_a_patch_of_inliers_counts_whatever_its_own_errors() -> None:
    errors, hand = torch.zeros(1, 32, 32), torch.ones(1, 32, 32, dtype=torch.bool)
    errors[0, 10:14, 10:14] = 1.0
    alone = find_inliers(errors, hand, 0.5, box=False, patch=False)
    assert torch.equal(alone, errors < 0.5)
    assert find_inliers(errors, hand, 0.5, box=False, patch=True).all()
    errors[0, 8:24, 8:24] = 1.0
    kept = find_inliers(errors, hand, 0.5, box=True, patch=True)
    assert not kept[0, 11:21, 11:21].any()


def test_errors_are_means_over_channels() -> None:
    image = torch.tensor([[[[0.1, 0.5, 0.3]]]], requires_grad=True)
    errors = pixel_errors(image, torch.tensor([[[[0.4, 0.5, 0.0]]]]))
    assert errors.item() == pytest.approx(0.2)
    assert not errors.requires_grad


@pytest.mark.parametrize(
    ("fraction", "steps", "expected"),
    [
        (0.0, 30_000.0, 1.0),
        (0.01, 30_000.0, math.exp(-0.003 * 200)),  # step 300: floor(301 / 1.5)
        (0.5, 3_000.0, math.exp(-0.003 * 1000)),  # step 1500: floor(1501 / 1.5)
        (0.0, 0.0, 0.0),
    ],
)
def test_the_schedule_is_the_published_one(fraction: float, steps: float, expected: float) -> None:
    assert chance_of_all(fraction, steps) == pytest.approx(expected, rel=1e-12)
