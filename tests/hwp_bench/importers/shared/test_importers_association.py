"""Which hand is which. Oracle: moving hands of known sides, exchanged, hidden and misjudged."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from hwp_bench.importers.shared.landmarks import HandTracks, associate

FRAMES = 60
SHAPE = np.random.default_rng(0).uniform(-50, 50, (21, 2))


def truth(crossing: bool = True) -> np.ndarray:
    """(2, F, 21, 3): a right hand that goes from left to right and a left one against it."""
    time = np.linspace(0, 1, FRAMES)
    across = 100 + 400 * time if crossing else np.full(FRAMES, 150.0)
    down = 200 + 30 * np.sin(6 * time)
    centres = np.stack([np.stack([across, down], 1), np.stack([620 - across, down + 25], 1)])
    image = np.zeros((2, FRAMES, 21, 3), np.float32)
    image[0, :, :, :2] = centres[0][:, None] + SHAPE
    image[1, :, :, :2] = centres[1][:, None] + SHAPE * (-1, 1)
    return image


def tracked(image: np.ndarray, swapped: np.ndarray, hidden: np.ndarray, right: np.ndarray):
    """What a tracker says that exchanges hands in some frames and misses some."""
    score = np.where(hidden, 0.0, 0.9).astype(np.float32)
    made = HandTracks(
        np.where(hidden[..., None, None], 0, image),
        np.where(hidden[..., None, None], 0, image / 1000),
        score,
        np.where(hidden, 0.5, right).astype(np.float32),
        np.where(hidden, -1, 0).astype(np.int32),
        (640, 480),
    )

    def rows(values: np.ndarray) -> np.ndarray:
        return np.where(swapped.reshape(1, -1, *[1] * (values.ndim - 2)), values[::-1], values)

    return HandTracks(*map(rows, made.arrays.values()), made.size)


def votes() -> np.ndarray:
    return np.stack([np.full(FRAMES, 0.9), np.full(FRAMES, 0.1)])


@settings(max_examples=40)
@given(
    swaps=st.lists(st.integers(0, FRAMES - 1), max_size=8),
    gaps=st.lists(st.tuples(st.integers(0, 1), st.integers(0, FRAMES - 8)), max_size=4),
    wrong=st.sets(st.integers(0, FRAMES - 1), max_size=3),
    seed=st.integers(0, 99),
)
@example(swaps=[], gaps=[(0, 0)], wrong={0}, seed=0)
def test_swaps_gaps_and_wrong_votes_are_repaired(
    swaps: list[int], gaps: list[tuple[int, int]], wrong: set[int], seed: int
) -> None:
    random = np.random.default_rng(seed)
    image = truth()
    image[..., :2] += random.normal(0, 2, image[..., :2].shape)
    swapped = np.zeros(FRAMES, bool)
    for first in swaps:
        swapped[first:] ^= True
    hidden = np.zeros((2, FRAMES), bool)
    for hand, first in gaps:
        hidden[hand, first : first + 6] = True
    right = votes()
    right[:, sorted(wrong)] = 1 - right[:, sorted(wrong)]
    given_tracks = tracked(image, swapped, hidden, right)
    found = associate(given_tracks)
    np.testing.assert_array_equal(found.tracks.score > 0, ~hidden)
    expected = np.where(hidden[..., None, None], 0, image)
    np.testing.assert_array_equal(found.tracks.image, expected)
    # Exchanges that fall where nothing is seen cannot be told from one another.
    moments = ~hidden.all(axis=0)
    assert found.swaps == np.count_nonzero(np.diff(swapped[moments].astype(int)))
    assert found.doubles == 0


def test_a_hand_that_is_missed_until_it_is_elsewhere_is_known_by_votes() -> None:
    image, hidden = truth(), np.zeros((2, FRAMES), bool)
    hidden[:, 15:45] = True
    swapped = np.arange(FRAMES) >= 45
    found = associate(tracked(image, swapped, hidden, votes()))
    expected = np.where(hidden[..., None, None], 0, image)
    np.testing.assert_array_equal(found.tracks.image, expected)


def test_sound_tracks_stay_as_they_are() -> None:
    nothing = np.zeros((2, FRAMES), bool)
    given_tracks = tracked(truth(crossing=False), nothing[0], nothing, votes())
    found = associate(given_tracks)
    assert (found.swaps, found.doubles) == (0, 0)
    for name, values in given_tracks.arrays.items():
        np.testing.assert_array_equal(found.tracks.arrays[name], values)
    one = HandTracks(*(values[:1] for values in given_tracks.arrays.values()), (640, 480))
    assert associate(one).tracks is one


@pytest.mark.parametrize("better", [0, 1])
def test_one_hand_that_is_seen_twice_counts_once(better: int) -> None:
    image, nothing = truth(), np.zeros((2, FRAMES), bool)
    # The tracker's left hand has jumped onto the right one.
    image[1, 20:24] = image[0, 20:24] + 3
    made = tracked(image, nothing[0], nothing, votes())
    made.score[better] = 0.95
    found = associate(made)
    assert found.doubles == 4
    assert (np.count_nonzero(found.tracks.score > 0, axis=0) == 1).sum() == 4
    # What is left is where the right hand is, and is the right hand: the left one is elsewhere.
    assert (found.tracks.score[0, 20:24] > 0).all()
    assert (found.tracks.score[1, 20:24] == 0).all()
    assert (np.delete(found.tracks.score, np.s_[20:24], axis=1) > 0).all()
