"""Following hands through frames. Oracle: discs whose places are known, seen by fake networks."""

from __future__ import annotations

import numpy as np
import pytest
from fake_networks import LAYOUT, RADIUS, FakeNetworks, picture

from hwp_bench.base.errors import UsageError
from hwp_bench.importers.shared.landmarks import HandTracks
from hwp_bench.tracking.track_video import TrackerSettings, track_frames

Clip = list[dict[str, tuple[float, float]]]


def hands_of(clip: Clip, networks: FakeNetworks, hands: int = 2) -> HandTracks | None:
    collected = track_frames(map(picture, clip), networks, TrackerSettings(hands))
    assert collected.frames == len(clip)
    return collected.hands((160, 120), hands)


def error(tracks: HandTracks, hand: int, clip: Clip, side: str) -> np.ndarray:
    """(F,) distance of the landmarks from those of a disc, px; NaN where the hand is not seen."""
    places = np.array([frame.get(side, (np.nan, np.nan)) for frame in clip])
    expected = places[:, None] + LAYOUT * RADIUS
    distance = np.linalg.norm(tracks.image[hand, :, :, :2] - expected, axis=2).mean(axis=1)
    return np.where(tracks.seen(hand), distance, np.nan)


def test_one_hand_is_found_lost_and_found_again() -> None:
    clip: Clip = [{"right": (30 + 2 * k, 60)} for k in range(30)]
    for gone in range(12, 17):
        clip[gone] = {}
    networks = FakeNetworks(wrong_every=4)
    tracks = hands_of(clip, networks)
    assert tracks is not None
    assert len(tracks.score) == 1
    np.testing.assert_array_equal(~tracks.seen(0), [12 <= k < 17 for k in range(30)])
    assert set(tracks.track[0].tolist()) == {-1, 0, 1}
    # A quarter of the answers names the other side; all frames vote.
    assert tracks.side(0) == "right"
    assert 0.6 < tracks.votes(0)["right"] < 0.8
    # Rounding to pixels of the crop, twice.
    assert np.nanmax(error(tracks, 0, clip, "right")) < 1.5


def test_palms_are_searched_only_while_a_hand_is_missing() -> None:
    one: Clip = [{"right": (60, 60)}] * 11
    networks = FakeNetworks()
    hands_of(one, networks, hands=1)
    assert networks.palm_calls == 1
    networks = FakeNetworks()
    hands_of(one, networks, hands=2)
    # Frames 0, 5 and 10.
    assert networks.palm_calls == 3
    assert networks.hand_calls == 11


def test_a_lost_hand_is_searched_in_every_frame() -> None:
    both = {"left": (40, 60), "right": (120, 60)}
    clip: Clip = [both] * 7 + [{"left": (40, 60)}] * 4 + [both] * 3
    tracks = hands_of(clip, FakeNetworks())
    assert tracks is not None
    right = tracks.hand_of("right")
    assert right is not None
    np.testing.assert_array_equal(tracks.seen(right), [k < 7 or k >= 11 for k in range(14)])


def test_two_hands_that_cross_keep_their_sides() -> None:
    # The left hand covers the right one in the middle.
    clip: Clip = [{"right": (20 + 4 * k, 57), "left": (140 - 4 * k, 63)} for k in range(31)]
    tracks = hands_of(clip, FakeNetworks(wrong_every=5))
    assert tracks is not None
    assert [tracks.side(hand) for hand in range(2)] in (["right", "left"], ["left", "right"])
    right, left = tracks.hand_of("right"), tracks.hand_of("left")
    assert right is not None
    assert left is not None
    assert tracks.seen(left).sum() >= 29
    assert tracks.seen(right).sum() >= 24
    assert np.nanmedian(error(tracks, left, clip, "left")) < 1.5
    apart = np.abs(np.arange(31) - 15) > 5
    for hand, side in ((right, "right"), (left, "left")):
        assert np.nanmax(error(tracks, hand, clip, side)[apart]) < 1.5


def test_a_second_hand_that_comes_later_is_a_hand_of_its_own() -> None:
    clip: Clip = [{"left": (40, 60)} for _ in range(20)]
    for frame in range(10, 20):
        clip[frame] = {"left": (40, 60), "right": (120, 60)}
    tracks = hands_of(clip, FakeNetworks())
    assert tracks is not None
    assert [tracks.side(0), tracks.side(1)] == ["left", "right"]
    assert tracks.seen(0).all()
    np.testing.assert_array_equal(tracks.seen(1), np.arange(20) >= 10)


def test_a_short_track_of_the_other_side_is_the_same_hand() -> None:
    # Lost for two frames, and then named wrongly in its last frames.
    clip: Clip = [{"right": (60, 60)} for _ in range(30)]
    clip[26] = clip[27] = {}
    networks = FakeNetworks()
    answer = networks.hand

    def wrong_at_the_end(image: np.ndarray) -> object:
        reading = answer(image)
        late = networks.hand_calls > 27
        return type(reading)(reading.image, reading.world, reading.presence, 0.1 if late else 0.9)

    networks.hand = wrong_at_the_end  # type: ignore[assignment, method-assign]
    tracks = hands_of(clip, networks)
    assert tracks is not None
    assert len(tracks.score) == 1
    assert tracks.seen(0).sum() == 28


def test_nothing_to_see_is_none() -> None:
    assert hands_of([{}] * 3, FakeNetworks()) is None


@pytest.mark.parametrize(("name", "value"), [("hands", 3), ("min_presence", 1.0)])
def test_settings_that_make_no_sense(name: str, value: float) -> None:
    with pytest.raises(UsageError, match=name):
        TrackerSettings(**{name: value})  # type: ignore[arg-type]
