"""The file of tracked hands: one or two hands over all frames of a video, and which side they are.

An `.npz` of version 2. It contains what version 1 contains (`image`, `world` and `score` of one
hand), for the hand that is seen most, so that every reader of version 1 reads it.
"""

from __future__ import annotations

import os
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from hwp_bench.base.arrays import read_npz, take, write_npz
from hwp_bench.base.errors import BadInput

#: Version of the file that is written.
VERSION = 2
#: Sides in the order of `votes`.
SIDES = ("right", "left")


@dataclass(frozen=True, eq=False)
class HandTracks:
    """Up to two hands in every frame of a video, the one that is seen most first.

    Attributes:
        image: (H, F, 21, 3) float32, x, y in px of the whole frame, z in the same unit; zero where
            the hand is not seen.
        world: (H, F, 21, 3) float32, m.
        score: (H, F) float32, the tracker's confidence in [0, 1]; 0 where the hand is not seen.
        right: (H, F) float32, the network's probability that it is a right hand; 0.5 where the
            hand is not seen.
        track: (H, F) int32, number of the stretch in which the hand was followed; -1 where the
            hand is not seen.
        size: (width, height) of the video, px.
    """

    image: np.ndarray
    world: np.ndarray
    score: np.ndarray
    right: np.ndarray
    track: np.ndarray
    size: tuple[int, int]

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
            "image": tracks.image[0],
            "world": tracks.world[0],
            "score": tracks.score[0],
            "hands_image": tracks.image,
            "hands_world": tracks.world,
            "hands_score": tracks.score,
            "hands_right": tracks.right,
            "hands_track": tracks.track,
        },
    )


def read_hand_tracks(path: str | os.PathLike[str]) -> HandTracks | None:
    """Read the hands of a file of version 2.

    Returns:
        The hands; None for a file of version 1, which says nothing of sides.

    Raises:
        BadInput: the file is damaged, of a newer version, or its arrays do not fit together.
    """
    return tracks_of(read_npz(path), path)


def tracks_of(arrays: Mapping[str, np.ndarray], where: str | os.PathLike[str]) -> HandTracks | None:
    """Check the arrays of a file; `read_hand_tracks` says how."""
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
    shape = (hands, frames, 21, 3)
    image = take(arrays, "hands_image", shape, where=where, dtype=np.float32)
    world = take(arrays, "hands_world", shape, where=where, dtype=np.float32)
    right = take(arrays, "hands_right", (hands, frames), where=where, dtype=np.float32)
    track = take(arrays, "hands_track", (hands, frames), where=where, dtype=np.int32)
    for name, values in (("hands_score", score), ("hands_right", right)):
        if values.min() < 0 or values.max() > 1:
            raise BadInput("has values outside [0, 1]", where=where, field=name)
    width, height = take(arrays, "size", (2,), where=where, dtype=np.int64)
    return HandTracks(image, world, score, right, track, (int(width), int(height)))
