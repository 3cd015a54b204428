"""From tracks to hands: which stretches of frames belong to one hand, and which side it is.

A track ends where its hand is lost, and the next one has another number. The network says in each
frame whether it sees a right or a left hand. It errs in single frames, so that all frames of a
track vote together.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from hwp_bench.importers.shared.hand_tracks import HandTracks
from hwp_bench.tracking.tracker import TrackedHand

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
        self._frame: list[int] = []
        self._track: list[int] = []
        self._image: list[np.ndarray] = []
        self._world: list[np.ndarray] = []
        self._scores: list[tuple[float, float]] = []
        self.frames = 0

    def add(self, hands: Sequence[TrackedHand]) -> None:
        """Take the hands of the next frame."""
        for one in hands:
            self._frame.append(self.frames)
            self._track.append(one.track)
            self._image.append(one.hand.image.astype(np.float32))
            self._world.append(one.hand.world.astype(np.float32))
            self._scores.append((one.hand.presence, one.hand.right))
        self.frames += 1

    def hands(self, size: tuple[int, int], most: int) -> HandTracks | None:
        """Join the tracks to hands.

        Args:
            size: (width, height) of the video, px.
            most: hands, 1 or 2.

        Returns:
            The hands; None where nothing was seen.
        """
        if not self._frame:
            return None
        frame, track = np.array(self._frame), np.array(self._track, dtype=np.int32)
        scores = np.clip(np.array(self._scores, dtype=np.float32), 0, 1)
        image, world = np.stack(self._image), np.stack(self._world)
        owner = _owners(frame, track, scores[:, 1], most)
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
        made.score[place], made.right[place] = scores[kept, 0], scores[kept, 1]
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
        first, second = _joined(first, second), []
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


def _joined(first: list[_Track], second: list[_Track]) -> list[_Track]:
    """One hand of two sides: tracks of the second fill frames in which the first is not seen."""
    taken = {frame for one in first for frame in one.frames.tolist()}
    return [*first, *(one for one in second if taken.isdisjoint(one.frames.tolist()))]
