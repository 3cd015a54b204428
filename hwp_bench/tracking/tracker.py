"""Follows up to two hands from frame to frame.

A hand that was seen in the last frame is looked for around the place where it was; palms are
searched only while fewer hands are followed than may be there. Source: MediaPipe's graph
`hand_landmark_tracking_cpu`. Two tracks that end on one hand are made one here, which only the
newer Tasks of MediaPipe do.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from hwp_bench.base.errors import UsageError
from hwp_bench.importers.shared.landmarks import HandTracks
from hwp_bench.tracking.networks import (
    HAND_EDGE,
    LiteRtNetworks,
    Region,
    SeenHand,
    cut_region,
    decode,
    overlap,
    palm_input,
    place_in_image,
    suppress,
)

#: Two regions with more overlap than this show one hand.
_SAME_REGION = 0.5
#: Two hands are one if their landmarks differ by less than this share of their size, on average.
_SAME_HAND = 0.2


@dataclass(frozen=True)
class TrackerSettings:
    """Settings of the tracker; the defaults are MediaPipe's."""

    #: Most hands in a frame, 1 or 2.
    hands: int = 2
    #: Palms below this score are left out.
    min_palm_score: float = 0.5
    #: Hands below this presence are lost.
    min_presence: float = 0.5

    def __post_init__(self) -> None:
        if self.hands not in (1, 2):
            raise UsageError(f"is {self.hands}", field="hands", remedy="Use 1 or 2.")
        for name in ("min_palm_score", "min_presence"):
            value = getattr(self, name)
            if not 0 < value < 1:
                raise UsageError(f"is {value}", field=name, remedy="Use a number between 0 and 1.")


@dataclass(frozen=True, eq=False)
class TrackedHand:
    """A hand in a frame."""

    #: Number of the track, a stretch of frames without a gap; counts from 0.
    track: int
    #: What was seen.
    hand: SeenHand


class HandTracker:
    """Follows hands through consecutive frames."""

    def __init__(self, networks: LiteRtNetworks, settings: TrackerSettings | None = None) -> None:
        self._networks = networks
        self._settings = settings or TrackerSettings()
        self._followed: list[TrackedHand] = []
        self._tracks = 0

    def step(self, frame: np.ndarray) -> list[TrackedHand]:
        """Find the hands of the next frame, (H, W, 3) uint8 RGB; known ones keep their tracks."""
        seen: list[tuple[TrackedHand, float]] = []
        for region, before in self._regions(frame):
            image = cut_region(frame, region, HAND_EDGE, outside_black=False)
            reading = self._networks.hand(image)
            values = (reading.presence, reading.right)
            if not np.isfinite(values).all() or reading.presence < self._settings.min_presence:
                continue
            hand = reading.place_in(region)
            if not (np.isfinite(hand.image).all() and np.isfinite(hand.world).all()):
                continue
            moved = np.inf if before is None else _distance(hand, before.hand)
            track = -1 if before is None else before.track
            seen.append((TrackedHand(track, hand), moved))
        self._followed = []
        for one in _without_doubles(seen)[: self._settings.hands]:
            number = one.track
            if number < 0:
                # A new track.
                number, self._tracks = self._tracks, self._tracks + 1
            self._followed.append(TrackedHand(number, one.hand))
        return list(self._followed)

    def _regions(self, frame: np.ndarray) -> list[tuple[Region, TrackedHand | None]]:
        """Regions to look at, with the hand that each of them follows."""
        followed: list[tuple[Region, TrackedHand | None]] = []
        for hand in self._followed:
            region = hand.hand.next_region()
            if _is_sound(region, frame):
                followed = [one for one in followed if overlap(one[0], region) <= _SAME_REGION]
                followed.append((region, hand))
        for region in self._new_regions(frame) if len(followed) < self._settings.hands else ():
            if all(overlap(region, other) <= _SAME_REGION for other, _ in followed):
                followed.append((region, None))
        return followed

    def _new_regions(self, frame: np.ndarray) -> list[Region]:
        """Regions of the palms in a frame, best first."""
        height, width = frame.shape[:2]
        values, logits = self._networks.palms(palm_input(frame))
        palms = suppress(decode(values, logits, self._settings.min_palm_score))
        regions = [place_in_image(palm, width, height).hand_region() for palm in palms]
        return [region for region in regions[: self._settings.hands] if _is_sound(region, frame)]


def _without_doubles(seen: list[tuple[TrackedHand, float]]) -> list[TrackedHand]:
    """Hands without those that are another hand again; what moved least comes first and is kept."""
    kept: list[TrackedHand] = []
    for hand, _ in sorted(seen, key=lambda pair: pair[1]):
        size = hand.hand.size()
        if all(
            _distance(hand.hand, other.hand) > _SAME_HAND * max(size, other.hand.size())
            for other in kept
        ):
            kept.append(hand)
    return kept


def _distance(one: SeenHand, other: SeenHand) -> float:
    """Mean distance of the landmarks of two hands, px."""
    return float(np.linalg.norm(one.image[:, :2] - other.image[:, :2], axis=1).mean())


def _is_sound(region: Region, frame: np.ndarray) -> bool:
    """Whether a region can be looked at: of a size, and not far outside of the frame."""
    height, width = frame.shape[:2]
    longest = max(width, height)
    return (
        2 <= region.width <= 8 * longest
        and 2 <= region.height <= 8 * longest
        and -longest <= region.x <= width + longest
        and -longest <= region.y <= height + longest
    )


# --- From tracks to hands: which stretches of frames belong to one hand, and which side it is
#
# A track ends where its hand is lost, and the next one has another number. The network says in
# each frame whether it sees a right or a left hand. It errs in single frames, so that all frames
# of a track vote together.

#: A second hand is seen in at least this share of the frames that show the first; what is less is
#: the first hand with a wrong side, or a mistake.
_SECOND_HAND = 0.1
#: Strongest vote of one frame, in units of probability away from 0.5.
_VOTE = 0.5


@dataclass(frozen=True, eq=False)
class _Track:
    """One track: its number, its frames, the rows of its hands, and what they vote for."""

    number: int
    frames: np.ndarray
    rows: np.ndarray
    votes: float


class Collected:
    """Everything that the tracker saw, in the order of the frames; 600 bytes for each hand."""

    def __init__(self) -> None:
        # Frame, track, landmarks in the image and in space, presence, right.
        self._rows: list[tuple[int, int, np.ndarray, np.ndarray, float, float]] = []
        self.frames = 0

    def add(self, hands: Sequence[TrackedHand]) -> None:
        """Take the hands of the next frame."""
        for one in hands:
            image, world = one.hand.image.astype(np.float32), one.hand.world.astype(np.float32)
            scores = (one.hand.presence, one.hand.right)
            self._rows.append((self.frames, one.track, image, world, *scores))
        self.frames += 1

    def hands(self, size: tuple[int, int], most: int) -> HandTracks | None:
        """Join the tracks to 1 or 2 (`most`) hands; None where nothing was seen. `size`: px."""
        if not self._rows:
            return None
        frame, track, image, world, score, right = map(np.array, zip(*self._rows, strict=True))
        score, right = (np.clip(part.astype(np.float32), 0, 1) for part in (score, right))
        owner = _owners(frame, track, right, most)
        count = int(owner.max()) + 1
        shape = (count, self.frames)
        made = HandTracks(
            np.zeros((*shape, 21, 3), np.float32),
            np.zeros((*shape, 21, 3), np.float32),
            np.zeros(shape, np.float32),
            np.full(shape, 0.5, np.float32),
            np.full(shape, -1, np.int32),
            size,
        )
        kept = owner >= 0
        place = owner[kept], frame[kept]
        made.image[place], made.world[place] = image[kept], world[kept]
        made.score[place], made.right[place] = score[kept], right[kept]
        made.track[place] = track[kept]
        return made


def _owners(frame: np.ndarray, track: np.ndarray, right: np.ndarray, most: int) -> np.ndarray:
    """The hand of each row: 0 for the one that is seen most, 1 for the other, -1 for none."""
    tracks = []
    for number in np.unique(track):
        rows = np.flatnonzero(track == number)
        votes = float(np.clip(right[rows].astype(np.float64) - 0.5, -_VOTE, _VOTE).sum())
        tracks.append(_Track(int(number), frame[rows], rows, votes))
    sides = _by_side(tracks)
    lengths = [sum(len(one.frames) for one in side) for side in sides]
    first, second = sides if lengths[0] >= lengths[1] else sides[::-1]
    if most == 1 or min(lengths) < _SECOND_HAND * max(lengths):
        # Tracks of the second fill frames in which the first is not seen.
        taken = {frame for one in first for frame in one.frames.tolist()}
        spare = [one for one in second if taken.isdisjoint(one.frames.tolist())]
        first, second = [*first, *spare], []
    owner = np.full(len(frame), -1)
    for hand, side in enumerate((first, second)):
        for one in side:
            owner[one.rows] = hand
    return owner


def _by_side(tracks: list[_Track]) -> tuple[list[_Track], list[_Track]]:
    """Right and left tracks.

    Two tracks of one frame are different hands, so that the surer one has the first choice.
    """
    sides: tuple[list[_Track], list[_Track]] = ([], [])
    taken: tuple[set[int], set[int]] = (set(), set())
    for one in sorted(tracks, key=lambda track: -abs(track.votes)):
        frames = set(one.frames.tolist())
        wanted = 0 if one.votes >= 0 else 1
        for side in (wanted, 1 - wanted):
            if not frames & taken[side]:
                sides[side].append(one)
                taken[side].update(frames)
                break
    return sides
