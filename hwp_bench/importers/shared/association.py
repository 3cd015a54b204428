"""Which of two tracked hands is which, frame by frame: swaps and doubles of a tracker are repaired.

A tracker may change its mind where hands cross or one comes back from behind the other. Every
frame has two possible assignments of its hands to the sides. The cheapest sequence of them is
found by dynamic programming (Viterbi, 1967): a hand is expected where it was, moved on with its
speed, and costs what the network's vote for the other side says. Where hands lie on each other the
votes decide, and where single votes err the motion does.
"""

from __future__ import annotations

import os
from dataclasses import dataclass, replace

import numpy as np

from hwp_bench.importers.shared.hand_tracks import SIDES, HandTracks, read_hand_tracks

#: Landmarks that move with the palm; fingers move too fast to be expected anywhere.
_PALM = (0, 1, 5, 9, 13, 17)
#: Error of a place that is expected one frame ahead, as a share of the hand's size.
_MOTION = 0.1
#: Most that a jump costs: a hand that comes back may be anywhere.
_MOST_MOTION = 10.0
#: Cost of a hand that was never seen before. Without it, one that is seen alone with a wrong vote
#: would become the other hand, and be seen for the first time in the next frame.
_FIRST_SEEN = 5.0
#: The speed of a hand is known for this many frames after it was seen.
_MEMORY = 3
#: Weight of a vote: those of frames next to each other err together.
_VOTE = 0.3
#: No single vote is surer than this.
_SUREST = 0.95
#: A second hand is seen in at least this share of the frames that show the first.
_SECOND_HAND = 0.1
#: Two hands are one that is seen twice if their landmarks are nearer than this share of its size.
_SAME_HAND = 0.15


@dataclass(frozen=True, eq=False)
class Association:
    """Hands that are the same in all frames.

    Attributes:
        tracks: the right hand first, then the left one; one hand as it was given.
        swaps: how often the tracker had exchanged the hands from one frame to the next.
        doubles: number of frames in which it had put both on one hand.
    """

    tracks: HandTracks
    swaps: int
    doubles: int


@dataclass(frozen=True, eq=False)
class _Path:
    """The cheapest sequence up to a frame that ends in one assignment; rows are right and left."""

    cost: float
    #: (2, P, 2) px, where each hand was seen last, and (2, P, 2) px a frame, its speed.
    place: np.ndarray
    speed: np.ndarray
    #: (2,) frame in which each was seen last, -1 before.
    frame: tuple[int, int]


def associate(tracks: HandTracks) -> Association:
    """Assign the two hands of every frame to the right and the left hand.

    Args:
        tracks: one or two hands; what is in a row may change from frame to frame.
    """
    if len(tracks.score) == 1:
        return Association(tracks, 0, 0)
    seen = (tracks.score > 0) & np.isfinite(tracks.image).all(axis=(2, 3))
    size = _size(tracks, seen)
    double = _doubles(tracks, seen, size)
    score = tracks.score.copy()
    worse = tracks.score.argmin(axis=0)
    score[worse[double], double] = 0.0
    seen[worse[double], double] = False
    crossed = _crossed(tracks, seen, size)
    moments = np.flatnonzero(seen.any(axis=0))
    swaps = int(np.count_nonzero(np.diff(crossed[moments].astype(int))))
    return Association(_exchanged(replace(tracks, score=score), crossed), swaps, len(double))


def _size(tracks: HandTracks, seen: np.ndarray) -> float:
    """Median extent of a hand, px; at least 1."""
    shown = tracks.image[..., :2][seen]
    return max(float(np.median(np.ptp(shown, axis=1).max(axis=1))), 1.0) if len(shown) else 1.0


def _doubles(tracks: HandTracks, seen: np.ndarray, size: float) -> np.ndarray:
    """Frames in which both rows show one hand."""
    both = np.flatnonzero(seen.all(axis=0))
    apart = tracks.image[0, both, :, :2] - tracks.image[1, both, :, :2]
    return both[np.linalg.norm(apart, axis=-1).mean(axis=1) < _SAME_HAND * size]


def _crossed(tracks: HandTracks, seen: np.ndarray, size: float) -> np.ndarray:
    """Return (F,) bool: frames whose first row is the left hand."""
    places = tracks.image[:, :, list(_PALM), :2].astype(np.float64)
    right = np.clip(tracks.right.astype(np.float64), 1.0 - _SUREST, _SUREST)
    # Cost of calling the hand of each row a right one, and a left one.
    votes = -_VOTE * np.log(np.stack([right, 1.0 - right], axis=-1))
    count = seen.shape[1]
    nothing = np.zeros((2, len(_PALM), 2))
    paths = [_Path(0.0, nothing, nothing, (-1, -1))] * 2
    back = np.tile(np.arange(2), (count, 1))
    for frame in range(count):
        rows = np.flatnonzero(seen[:, frame]).tolist()
        if not rows:
            continue
        following = []
        for state in (0, 1):
            # In state 0 the first row is the right hand.
            sides = [row ^ state for row in rows]
            vote = sum(
                float(votes[row, frame, side]) for row, side in zip(rows, sides, strict=True)
            )
            shown = [(side, places[row, frame]) for row, side in zip(rows, sides, strict=True)]
            costs = [path.cost + vote + _motion(path, shown, frame, size) for path in paths]
            # Of equal ways the one without an exchange is taken.
            best = state if costs[state] <= costs[1 - state] else 1 - state
            back[frame, state] = best
            following.append(_moved(paths[best], costs[best], shown, frame))
        paths = following
    states = np.empty(count, dtype=bool)
    state = int(paths[1].cost < paths[0].cost)
    for frame in range(count - 1, -1, -1):
        states[frame] = state
        state = int(back[frame, state])
    return states


def _motion(path: _Path, shown: list[tuple[int, np.ndarray]], frame: int, size: float) -> float:
    """Cost of seeing hands at places, after a path."""
    cost = 0.0
    for side, place in shown:
        if path.frame[side] < 0:
            cost += _FIRST_SEEN
            continue
        gap = frame - path.frame[side]
        expected = path.place[side] + path.speed[side] * min(gap, _MEMORY)
        apart = float(np.linalg.norm(place - expected, axis=1).mean())
        cost += min(0.5 * (apart / (_MOTION * size)) ** 2 / gap, _MOST_MOTION)
    return cost


def _moved(path: _Path, cost: float, shown: list[tuple[int, np.ndarray]], frame: int) -> _Path:
    """The path with the hands of one more frame."""
    places, speeds, frames = path.place.copy(), path.speed.copy(), list(path.frame)
    for side, place in shown:
        gap = frame - frames[side]
        known = frames[side] >= 0 and gap <= _MEMORY
        speeds[side] = (place - places[side]) / gap if known else 0.0
        places[side], frames[side] = place, frame
    return _Path(cost, places, speeds, (frames[0], frames[1]))


def _exchanged(tracks: HandTracks, crossed: np.ndarray) -> HandTracks:
    """Exchange the rows of some frames."""

    def rows(values: np.ndarray) -> np.ndarray:
        where = crossed.reshape(1, -1, *[1] * (values.ndim - 2))
        return np.where(where, values[::-1], values)

    return replace(
        tracks,
        image=rows(tracks.image),
        world=rows(tracks.world),
        score=rows(tracks.score),
        right=rows(tracks.right),
        track=rows(tracks.track),
    )


def hand_of(tracks: HandTracks, side: str) -> int | None:
    """Return the row of a side in associated hands, None where none is of it."""
    return SIDES.index(side) if len(tracks.score) == 2 else tracks.hand_of(side)


def read_association(path: str | os.PathLike[str]) -> Association | None:
    """Read the hands of a file and associate them; None for a file that says nothing of sides.

    Raises:
        BadInput: as `read_hand_tracks` does.
    """
    tracks = read_hand_tracks(path)
    return None if tracks is None else associate(tracks)


def sides_of(tracks: HandTracks) -> tuple[str, ...]:
    """Return the sides of associated hands, the one that is seen most first.

    A second hand that is hardly ever seen is left out.
    """
    counts = [int(tracks.seen(hand).sum()) for hand in range(len(tracks.score))]
    if len(counts) == 1:
        return (tracks.side(0),)
    first = int(counts[1] > counts[0])
    if counts[1 - first] < _SECOND_HAND * counts[first]:
        return (SIDES[first],)
    return SIDES[first], SIDES[1 - first]


def tracked_sides(path: str | os.PathLike[str]) -> tuple[str, ...]:
    """Return the sides of a file's hands as `sides_of` does; none if it says nothing of sides."""
    found = read_association(path)
    return () if found is None else sides_of(found.tracks)


def tracked_votes(path: str | os.PathLike[str], side: str) -> dict[str, float] | None:
    """Return the votes of the hand that `read_landmarks` reads for a side.

    None for a file that says nothing of sides.
    """
    found = read_association(path)
    return None if found is None else found.tracks.votes(hand_of(found.tracks, side) or 0)
