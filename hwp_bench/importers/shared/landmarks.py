"""Tracked hands: the file, which hand is which in it, and the landmarks that an import reads.

The file is an `.npz` of version 2: one or two hands over all frames of a video, and which side they
are. It contains what version 1 contains (`image`, `world` and `score` of one hand), for the hand
that is seen most, so that every reader of version 1 reads it.

A tracker may change its mind where hands cross or one comes back from behind the other. Every
frame has two possible assignments of its hands to the sides. The cheapest sequence of them is
found by dynamic programming (Viterbi, 1967): a hand is expected to move with constant speed, and a
vote of the network for the other side has a cost. Where hands overlap the votes decide, and where
single votes are wrong the motion does.
"""

from __future__ import annotations

import os
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from hwp_bench.base.arrays import read_npz, take, write_npz
from hwp_bench.base.errors import BadInput
from hwp_bench.hands.skeleton import SIDES

#: Version of the file that is written.
VERSION = 2
#: MediaPipe (= OpenPose) order, the order of every landmark array in this package.
LANDMARK_NAMES = (
    "wrist",
    *(f"{finger}_{k}" for finger in ("thumb", "index", "middle", "ring", "little") for k in "1234"),
)
#: Landmarks that move with the palm: wrist, thumb base, and the four knuckles.
PALM = (0, 1, 5, 9, 13, 17)
# What other trackers' files contain too, of one hand.
_NAMES = ("image", "world", "score")
#: Range of a hand's extent, m: from a small child's fist to a large open hand, with a margin.
HAND_METRES = (0.02, 0.5)


@dataclass(frozen=True, eq=False)
class HandTracks:
    """Up to two hands in every frame of a video, the one that is seen most first.

    Where a hand is not seen its score is 0, and its other values have no meaning.
    """

    #: (H, F, 21, 3) float32, x, y in px of the whole frame, z in the same unit.
    image: np.ndarray
    #: (H, F, 21, 3) float32, m.
    world: np.ndarray
    #: (H, F) float32, the tracker's confidence in [0, 1].
    score: np.ndarray
    #: (H, F) float32, the network's probability that it is a right hand.
    right: np.ndarray
    #: (H, F) int32, number of the stretch in which the hand was followed.
    track: np.ndarray
    #: (width, height) of the video, px.
    size: tuple[int, int]

    @property
    def arrays(self) -> dict[str, np.ndarray]:
        """All but the size, by name."""
        return {name: value for name, value in vars(self).items() if name != "size"}

    def seen(self, hand: int) -> np.ndarray:
        """Return (F,) bool: frames in which a hand is seen."""
        return self.score[hand] > 0

    def votes(self, hand: int) -> dict[str, float]:
        """Return the mean probability of each side over the frames in which a hand is seen."""
        seen = self.seen(hand)
        if not seen.any():
            return dict.fromkeys(SIDES, 0.5)
        right = float(self.right[hand][seen].astype(np.float64).mean())
        return {"right": right, "left": 1.0 - right}

    def hand_of(self, side: str) -> int | None:
        """Return the hand of a side, None where none is of it."""
        hands = (hand for hand in range(len(self.score)) if self.side(hand) == side)
        return next(hands, None)

    def side(self, hand: int) -> str:
        """Return the side that most of the evidence is for; two hands are of both sides."""
        if len(self.score) == 2:
            first = self.votes(0)["right"] >= self.votes(1)["right"]
            return "right" if first == (hand == 0) else "left"
        return "right" if self.votes(hand)["right"] >= 0.5 else "left"


def write_hand_tracks(path: str | os.PathLike[str], tracks: HandTracks) -> Path:
    """Write the file, whole or not at all."""
    return write_npz(
        path,
        {
            "version": np.array([VERSION], dtype=np.int32),
            "size": np.array(tracks.size, dtype=np.int32),
            **{name: tracks.arrays[name][0] for name in _NAMES},
            **{f"hands_{name}": value for name, value in tracks.arrays.items()},
        },
    )


def read_hand_tracks(path: str | os.PathLike[str]) -> HandTracks | None:
    """Read the hands of a file of version 2; None for one of version 1, without sides."""
    return _tracks_of(read_npz(path), path)


def _tracks_of(
    arrays: Mapping[str, np.ndarray], where: str | os.PathLike[str]
) -> HandTracks | None:
    if "version" not in arrays:
        return None
    version = int(take(arrays, "version", (1,), where=where, dtype=np.int64)[0])
    if version != VERSION:
        raise BadInput(
            f"is of version {version}, this program reads 1 and {VERSION}",
            where=where,
            field="version",
            remedy="Use a newer version of this program, or track the video again.",
        )
    score = take(arrays, "hands_score", (None, None), where=where, dtype=np.float32)
    hands, frames = score.shape
    if hands not in (1, 2) or frames < 1:
        raise BadInput(
            f"has shape {score.shape}, expected (1 or 2, frames)", where=where, field="hands_score"
        )
    image, world = (
        take(arrays, f"hands_{name}", (hands, frames, 21, 3), where=where, dtype=np.float32)
        for name in ("image", "world")
    )
    right = take(arrays, "hands_right", (hands, frames), where=where, dtype=np.float32)
    track = take(arrays, "hands_track", (hands, frames), where=where, dtype=np.int32)
    for name, values in (("hands_score", score), ("hands_right", right)):
        if values.min() < 0 or values.max() > 1:
            raise BadInput("has values outside [0, 1]", where=where, field=name)
    width, height = take(arrays, "size", (2,), where=where, dtype=np.int64)
    return HandTracks(image, world, score, right, track, (int(width), int(height)))


# --- Which hand is which, frame by frame: swaps and doubles of a tracker are repaired

# Error of a place that is expected one frame ahead, as a share of the hand's size. Of landmarks
# that move with the palm; fingers move too fast to be expected anywhere.
_MOTION = 0.1
# Most that a jump costs: a hand that comes back may be anywhere.
_MOST_MOTION = 10.0
# Cost of a hand that was never seen before. Without it, one that is seen alone with a wrong vote
# would become the other hand, and be seen for the first time in the next frame.
_FIRST_SEEN = 5.0
# The speed of a hand is known for this many frames after it was seen.
_MEMORY = 3
# Weight of a vote: those of frames next to each other err together. No single one is surer than
# `_SUREST`.
_VOTE, _SUREST = 0.3, 0.95
# A second hand is seen in at least this share of the frames that show the first.
_SECOND_HAND = 0.1
# Two hands are one that is seen twice if their landmarks are nearer than this share of its size.
_SAME_HAND = 0.15


@dataclass(frozen=True, eq=False)
class Association:
    """Hands that are the same in all frames."""

    #: The right hand first, then the left one; one hand as it was given.
    tracks: HandTracks
    #: How often the tracker had exchanged the hands from one frame to the next.
    swaps: int
    #: Number of frames in which it had put both on one hand.
    doubles: int

    @property
    def sides(self) -> tuple[str, ...]:
        """Sides of the hands, the one seen most first; a second one must be seen often enough."""
        counts = [int(self.tracks.seen(hand).sum()) for hand in range(len(self.tracks.score))]
        if len(counts) == 1:
            return (self.tracks.side(0),)
        first = int(counts[1] > counts[0])
        if counts[1 - first] < _SECOND_HAND * counts[first]:
            return (SIDES[first],)
        return SIDES[first], SIDES[1 - first]

    def row(self, side: str) -> int | None:
        """The row of a side, None where no hand is of it."""
        two = len(self.tracks.score) == 2
        return SIDES.index(side) if two else self.tracks.hand_of(side)

    def votes(self, side: str) -> dict[str, float]:
        """The votes of the hand that `read_landmarks` reads for a side."""
        return self.tracks.votes(self.row(side) or 0)


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
    """Assign one or two hands, whose rows may change from frame to frame, to right and left."""
    if len(tracks.score) == 1:
        return Association(tracks, 0, 0)
    seen = (tracks.score > 0) & np.isfinite(tracks.image).all(axis=(2, 3))
    # Median extent of a hand, px.
    shown = tracks.image[..., :2][seen]
    size = max(float(np.median(np.ptp(shown, axis=1).max(axis=1))), 1.0) if len(shown) else 1.0
    # Frames in which both rows show one hand.
    both = np.flatnonzero(seen.all(axis=0))
    apart = tracks.image[0, both, :, :2] - tracks.image[1, both, :, :2]
    double = both[np.linalg.norm(apart, axis=-1).mean(axis=1) < _SAME_HAND * size]
    score = tracks.score.copy()
    worse = tracks.score.argmin(axis=0)
    score[worse[double], double] = 0.0
    seen[worse[double], double] = False
    crossed = _crossed(tracks, seen, size)
    moments = np.flatnonzero(seen.any(axis=0))
    swaps = int(np.count_nonzero(np.diff(crossed[moments].astype(int))))
    exchanged = {
        name: np.where(crossed.reshape(-1, *[1] * (rows.ndim - 2)), rows[::-1], rows)
        for name, rows in replace(tracks, score=score).arrays.items()
    }
    return Association(HandTracks(**exchanged, size=tracks.size), swaps, len(double))


def _crossed(tracks: HandTracks, seen: np.ndarray, size: float) -> np.ndarray:
    """Return (F,) bool: frames whose first row is the left hand."""
    places = tracks.image[:, :, list(PALM), :2].astype(np.float64)
    right = np.clip(tracks.right.astype(np.float64), 1.0 - _SUREST, _SUREST)
    # Cost of calling the hand of each row a right one, and a left one.
    votes = -_VOTE * np.log(np.stack([right, 1.0 - right], axis=-1))
    count = seen.shape[1]
    nothing = np.zeros((2, len(PALM), 2))
    paths = [_Path(0.0, nothing, nothing, (-1, -1))] * 2
    back = np.tile(np.arange(2), (count, 1))
    for frame in range(count):
        rows = np.flatnonzero(seen[:, frame]).tolist()
        if not rows:
            continue
        following = []
        for state in (0, 1):
            # In state 0 the first row is the right hand.
            vote = sum(float(votes[row, frame, row ^ state]) for row in rows)
            shown = [(row ^ state, places[row, frame]) for row in rows]
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


def read_association(path: str | os.PathLike[str]) -> Association | None:
    """Read the hands of a file and associate them; None for a file without sides."""
    tracks = read_hand_tracks(path)
    return None if tracks is None else associate(tracks)


# --- The landmarks of one hand


@dataclass(frozen=True)
class Landmarks:
    """Landmarks of one hand in every frame of a video."""

    #: (F, 21, 2) float64, x and y in pixels of the whole frame (centres at +0.5).
    image: np.ndarray
    #: (F, 21, 3) float64, metres, x right, y down, z away from the camera; the origin is near the
    #: hand's centre and the scale is the tracker's guess.
    world: np.ndarray
    #: (F,) float64, the tracker's confidence in [0, 1].
    score: np.ndarray
    #: (F,) bool, frames whose landmarks can be used.
    detected: np.ndarray

    @property
    def hand_size(self) -> float:
        """Median over the frames of the larger side of the landmarks' box, px."""
        pixels = self.image[self.detected]
        return float(np.median((pixels.max(axis=1) - pixels.min(axis=1)).max(axis=1)))

    def select(self, frames: np.ndarray) -> Landmarks:
        """Return the landmarks of some frames."""
        return Landmarks(*(values[frames] for values in vars(self).values()))


def read_landmarks(
    path: str | os.PathLike[str], *, min_score: float, side: str | None = None
) -> Landmarks:
    """Read a tracker's npz with `image` (F, 21, 2 or 3), `world` (F, 21, 3) and `score` (F,).

    A frame in which the tracker saw nothing has score 0; its landmarks may be NaN.
    """
    path, arrays = Path(path), read_npz(path)
    tracks = None if side is None else _tracks_of(arrays, path)
    if tracks is not None and side is not None:
        found = associate(tracks)
        hand = found.row(side)
        if hand is not None:
            arrays = {name: found.tracks.arrays[name][hand] for name in _NAMES}
    missing = [name for name in _NAMES if name not in arrays]
    if missing:
        raise BadInput(f"lacks the arrays {', '.join(missing)}", where=path)
    for name in _NAMES:
        if arrays[name].dtype.kind not in "fiu":
            said = f"holds {arrays[name].dtype}, expected numbers"
            raise BadInput(said, where=path, field=name)
    image, world, score = (arrays[name].astype(np.float64) for name in _NAMES)
    frames = len(score) if score.ndim == 1 else -1
    if frames < 1:
        raise BadInput(f"has shape {score.shape}, expected (frames,)", where=path, field="score")
    for name, array, last in (("image", image, (2, 3)), ("world", world, (3,))):
        if array.shape[:2] != (frames, 21) or array.ndim != 3 or array.shape[2] not in last:
            raise BadInput(
                f"has shape {array.shape}, expected ({frames}, 21, {last[-1]})",
                where=path,
                field=name,
                remedy="Landmarks are 21 per frame in MediaPipe order, one hand only.",
            )
    if not np.isfinite(score).all() or score.min() < 0 or score.max() > 1:
        raise BadInput("has values outside [0, 1]", where=path, field="score")
    image = image[:, :, :2]
    detected = (score > 0) & (score >= min_score)
    for name, array in (("image", image), ("world", world)):
        broken = detected & ~np.isfinite(array).all(axis=(1, 2))
        if broken.any():
            first = int(np.flatnonzero(broken)[0])
            raise BadInput(
                f"is not finite in {int(broken.sum())} frames with a score of at least "
                f"{min_score:g}, first in frame {first}",
                where=path,
                field=name,
                remedy="Set the score of frames without a hand to 0.",
            )
    if not detected.any():
        raise BadInput(
            f"no frame has a score of at least {min_score:g}",
            where=path,
            field="score",
            remedy="Track a hand first, or accept lower scores "
            "(`hwp-bench data import video --min-score`).",
        )
    extent = np.median(np.ptp(world[detected], axis=1).max(axis=1))
    low, high = HAND_METRES
    if not low <= extent <= high:
        raise BadInput(
            f"spans {extent:.3g} in a typical frame, which is not a hand in metres",
            where=path,
            field="world",
            remedy=f"World landmarks are metres; a hand spans {low:g} to {high:g}.",
        )
    usable = detected[:, None, None]
    return Landmarks(np.where(usable, image, 0.0), np.where(usable, world, 0.0), score, detected)


def read_sides(
    path: str | os.PathLike[str],
    side: str,
    tracked: Association | None = None,
    *,
    min_score: float,
) -> dict[str | None, Landmarks]:
    """Read the landmarks of `right`, `left`, `both` or, by `auto`, the hands that a file holds.

    The key is None where neither the file nor `side` says which hand it is. `tracked` is what
    `read_association` returns, where it is known already.
    """
    sides: tuple[str | None, ...] = (side,)
    if side not in SIDES:
        tracked = tracked or read_association(path)
        sides = (None,) if tracked is None else tracked.sides
        if side == "both" and len(sides) < 2:
            raise BadInput(
                "has landmarks of one hand",
                where=path,
                field="--side",
                remedy="Track the video with `hwp-bench data track`, or import one hand.",
            )
    return {side: read_landmarks(path, min_score=min_score, side=side) for side in sides}


def check_against_video(
    landmarks: Landmarks, frame_count: int, width: int, height: int, where: str | os.PathLike[str]
) -> Landmarks:
    """Check the landmarks against the video that they were tracked in, and return them.

    Frames are marked as not detected whose hand lies completely outside the image, leaves it by
    more than the image's size, or is smaller than 8 pixels.
    """
    if len(landmarks.score) != frame_count:
        raise BadInput(
            f"has {len(landmarks.score)} frames, the video has {frame_count}",
            where=where,
            field="score",
            remedy="Track every frame of exactly this video.",
        )
    low, high = landmarks.image.min(axis=1), landmarks.image.max(axis=1)
    size = np.array([width, height])
    inside = ((high > 0) & (low < size)).all(axis=1)
    inside &= ((low > -size) & (high < 2 * size)).all(axis=1)
    detected = landmarks.detected & inside & ((high - low).max(axis=1) >= 8)
    if not detected.any():
        raise BadInput(
            f"no landmark lies inside the {width}x{height} image",
            where=where,
            field="image",
            remedy="Landmarks are in pixels of the whole frame, not in [0, 1].",
        )
    return replace(landmarks, detected=detected)
