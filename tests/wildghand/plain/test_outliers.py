"""Pixels that fit badly. Oracles: numpy's quantiles, the rules in loops, gratings, cosines."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from wildghand.plain.outliers import (
    BINS,
    DIRECTIONS,
    LOOK,
    PLACE,
    WAVELENGTHS,
    ErrorHistogram,
    chances,
    encodings,
    find_inliers,
    look_features,
    make_network,
    oriented_energies,
    patch_likeness,
    pixel_errors,
    steepness,
    vote_loss,
)


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


@pytest.mark.parametrize("direction", range(DIRECTIONS))
@pytest.mark.parametrize("scale", range(len(WAVELENGTHS)))
def test_a_grating_moves_the_filter_of_its_direction_and_wavelength(
    direction: int, scale: int
) -> None:
    y, x = np.mgrid[:48, :48]
    angle = math.pi * direction / DIRECTIONS
    along = x * math.cos(angle) + y * math.sin(angle)
    grating = 0.5 + 0.4 * np.sin(2.0 * math.pi / WAVELENGTHS[scale] * along + 0.7)
    energies = oriented_energies(grating.astype(np.float32))[12:36, 12:36].mean(axis=(0, 1))
    assert np.argmax(energies) == scale * DIRECTIONS + direction


def test_an_even_surface_has_no_energy_and_the_colour_of_cielab() -> None:
    """White has L* = 100 and no colour; tolerance 1e-3 for OpenCV's tables and filters."""
    features = look_features(np.full((20, 24, 3), 255, dtype=np.uint8))
    assert features.shape == (20, 24, LOOK)
    np.testing.assert_allclose(features[..., 0], 1.0, atol=1e-3)
    np.testing.assert_allclose(features[..., 1:], 0.0, atol=1e-3)


def test_places_are_encoded_by_octaves() -> None:
    made = encodings(5, 3)
    assert made.shape == (5, 3, PLACE)
    row, column = 1 / 4, 2 / 2
    assert made[1, 2, 0] == pytest.approx(math.sin(math.pi * row), abs=1e-6)
    assert made[1, 2, 1] == pytest.approx(math.sin(2 * math.pi * row), abs=1e-6)
    assert made[1, 2, 20] == pytest.approx(math.cos(math.pi * row), abs=1e-6)
    assert made[1, 2, 40] == pytest.approx(math.sin(math.pi * column), abs=1e-6)
    assert made[1, 2, 60] == pytest.approx(math.cos(math.pi * column), abs=1e-6)


def test_the_loss_is_that_of_the_formula() -> None:
    network = make_network(LOOK + PLACE, 3, torch.device("cpu"))
    chance = torch.tensor([0.9, 0.8, 0.3, 0.6])
    surely, maybe = torch.tensor([1.0, 0.0, 1.0, 0.0]), torch.tensor([1.0, 1.0, 1.0, 0.0])
    steep = network["mask.in"].abs().max() * network["mask.out"].abs().max()
    expected = (0.1 + 0.0 + 0.7 + 0.6) / 4 + 0.5 * float(steep)
    assert float(vote_loss(chance, surely, maybe) + 0.5 * steepness(network)) == pytest.approx(
        expected
    )


def test_the_network_learns_a_colour_that_fits_badly() -> None:
    """At first it knows nothing; after 150 steps of Adam a colour tells the outliers."""
    network = make_network(LOOK + PLACE, 0, torch.device("cpu"))
    features = torch.zeros(400, LOOK + PLACE)
    outlier = torch.arange(400) % 4 == 0
    features[:, 0], features[:, 1] = 0.6, torch.where(outlier, -0.5, 0.2)
    assert (chances(features, network) - 0.5).abs().max() < 0.1
    optimizer = torch.optim.Adam([value.requires_grad_() for value in network.values()], lr=2e-2)
    inlier = (~outlier).float()
    for _ in range(150):
        loss = vote_loss(chances(features, network), inlier, inlier)
        loss = loss + 0.01 * steepness(network)
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
    found = chances(features, network).detach()
    assert found[outlier].max() < 0.2 < 0.8 < found[~outlier].min()


def test_patches_are_alike_whatever_their_brightness() -> None:
    """The oracle is the cosine of the pixels of one patch in opponent colours, in float64."""
    image, target = torch.rand(2, 1, 9, 9, 3, generator=torch.Generator().manual_seed(5))
    torch.testing.assert_close(
        patch_likeness(0.4 * target, target, 3), torch.ones(1, 9, 9), atol=1e-4, rtol=0.0
    )
    opponent = np.array([[1 / 3, 1 / 3, 1 / 3], [2.0, -2.0, 0.0], [1.0, 1.0, -2.0]])
    x, y = (value[0, 3:6, 4:7].double().numpy() @ opponent.T for value in (image, target))
    expected = (x * y).sum() / (np.linalg.norm(x) * np.linalg.norm(y))
    assert float(patch_likeness(image, target, 3)[0, 4, 5]) == pytest.approx(expected, abs=1e-4)


def test_green_and_black_are_unlike_skin_and_like_themselves() -> None:
    skin, green = torch.tensor([0.7, 0.5, 0.4]), torch.tensor([0.08, 0.78, 0.24])
    pairs = ((skin, 0.5 * skin, 1.0), (skin, green, -0.2), (skin, 0.0 * skin, 0.0))
    for first, second, expected in (*pairs, (0.0 * skin, 0.0 * skin, 1.0)):
        images = (color.expand(1, 7, 7, 3) for color in (first, second))
        found = float(patch_likeness(*images, 5)[0, 3, 3])
        assert found == pytest.approx(expected, abs=0.05), (first, second)
