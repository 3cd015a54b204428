"""Ordinary errors by place. Oracle: running means by hand, and clips whose errors are known."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from wildghand.pao.pao import MOST, PLACE_RATE, PerturbationAwareWeights, PlaceErrors
from wildghand.pao.regions import ClipRegions, FrameRegions, stack_regions

CPU = torch.device("cpu")
FRAMES, SIZE, MEDIAN = 10, 8, 0.02
#: Four places, each a quarter of the image, in every frame.
LABELS = np.kron(np.array([[0, 1], [2, 3]]), np.ones((4, 4))).astype(np.uint16)
REGIONS = [FrameRegions(LABELS) for _ in range(FRAMES)]
HAND = torch.ones(FRAMES, SIZE, SIZE, dtype=torch.bool)


def watcher(trust: torch.Tensor | None = None) -> PlaceErrors:
    trust = torch.ones(FRAMES) if trust is None else trust
    return PlaceErrors(ClipRegions(REGIONS, CPU), trust, 4)


def errors(place: int, value: float, frames: list[int] | None = None) -> torch.Tensor:
    """The median everywhere, but for a place in some frames."""
    found = torch.full((FRAMES, SIZE, SIZE), MEDIAN)
    for frame in range(FRAMES) if frames is None else frames:
        found[frame][torch.from_numpy(place == LABELS)] = value
    return found


def watched(places: PlaceErrors, error: torch.Tensor, rounds: int = 20) -> PlaceErrors:
    for _ in range(rounds):
        for row in range(FRAMES):
            rows = torch.tensor([row])
            places.watch(rows, error[rows], HAND[rows], MEDIAN)
    return places


def test_one_step_is_the_mean_by_hand() -> None:
    places = watcher()
    rows = torch.tensor([4])
    places.watch(rows, errors(2, 0.05)[rows], HAND[rows], MEDIAN)
    expected = [MEDIAN, MEDIAN, MEDIAN + PLACE_RATE * (0.05 - MEDIAN), MEDIAN]
    np.testing.assert_allclose(places.ordinary, expected, rtol=1e-5)
    # An error counts at most a few times what is ordinary.
    places.watch(rows, errors(1, 100.0)[rows], HAND[rows], MEDIAN)
    np.testing.assert_allclose(
        places.ordinary[1], MEDIAN + PLACE_RATE * (MOST - 1) * MEDIAN, rtol=1e-5
    )


def test_an_error_of_every_frame_becomes_ordinary_and_one_of_a_frame_does_not() -> None:
    always = watched(watcher(), errors(3, 0.2))
    assert float(always.ordinary[3]) == pytest.approx(0.2, rel=1e-3)
    once = watched(watcher(), errors(3, 0.2, [6]))
    assert float(once.ordinary[3]) < 2.0 * MEDIAN
    np.testing.assert_allclose(once.ordinary[:3], MEDIAN, rtol=1e-4)


def test_a_perturbed_frame_teaches_nothing() -> None:
    trust = torch.ones(FRAMES)
    trust[6] = 0.0
    places = watched(watcher(trust), errors(3, 0.2, [6]))
    np.testing.assert_allclose(places.ordinary, MEDIAN, rtol=1e-5)


def test_what_is_expected_is_never_below_the_median() -> None:
    places = watcher()
    rows = torch.tensor([0, 5, 2])
    np.testing.assert_allclose(places.expected(rows, MEDIAN), MEDIAN, rtol=1e-6)
    places.ordinary[:] = torch.tensor([0.5, 0.001, 0.0, 0.03])
    found = places.expected(rows, torch.tensor(MEDIAN))
    by_place = np.maximum([0.5, 0.001, 0.0, 0.03], MEDIAN)
    np.testing.assert_allclose(found, np.stack([by_place[LABELS]] * 3), rtol=1e-6)


def test_pixels_without_hand_and_without_a_number_say_nothing() -> None:
    places, rows = watcher(), torch.tensor([0])
    hand = HAND[rows] & torch.from_numpy(LABELS != 1)
    error = errors(0, 0.3)[rows]
    error[~hand] = torch.nan
    places.watch(rows, error, hand, MEDIAN)
    assert float(places.ordinary[1]) == 0.0
    error = errors(0, 0.3)[rows]
    error[0, 0, 0] = torch.inf
    before = places.ordinary.clone()
    places.watch(rows, error, hand, MEDIAN)
    assert bool(places.ordinary.isfinite().all())
    assert float(places.ordinary[0]) == float(before[0])


def test_batches_of_a_long_clip_know_the_same_places() -> None:
    """Regions of a clip that is too large for one table are put together batch by batch."""
    labels = [FrameRegions(LABELS), FrameRegions(np.minimum(LABELS, 1))]
    long = PlaceErrors(ClipRegions(labels, CPU, cache_bytes=0), torch.ones(2), 4)
    short = PlaceErrors(ClipRegions(labels, CPU), torch.ones(2), 4)
    for rows in (torch.tensor([1]), torch.tensor([0, 1]), torch.tensor([1, 1])):
        error = errors(1, 0.3)[: len(rows)]
        for places in (long, short):
            places.watch(rows, error, HAND[: len(rows)], MEDIAN)
        assert torch.equal(long.ordinary, short.ordinary)
        assert torch.equal(long.expected(rows, MEDIAN), short.expected(rows, MEDIAN))


def test_regions_count_in_the_ordinary_error_of_their_places() -> None:
    """Oracle: errors divided by the expected ones, and by one number for the whole hand."""
    module = PerturbationAwareWeights()
    error, omega = errors(3, 0.2)[:2], torch.zeros(2)
    regions, hand = stack_regions(REGIONS[:2]), HAND[:2]
    expected = torch.where(torch.from_numpy(LABELS == 3), 0.2, MEDIAN).expand(2, SIZE, SIZE)
    found = module(error, regions, hand, omega, expected)
    np.testing.assert_allclose(found.errors, 1.0, rtol=1e-5)
    plain = module(error, regions, hand, omega, torch.full_like(expected, MEDIAN))
    np.testing.assert_allclose(plain.errors[:, 3], 10.0, rtol=1e-5)
    assert float(plain.weights.detach()[:, 7, 7].max()) == 0.0
    assert float(found.weights.detach()[:, 7, 7].min()) > 0.5
