"""Tracked hand landmarks of a video: reading them, and deciding which frames to trust."""

from __future__ import annotations

import os
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from hwp_bench.base.arrays import read_npz
from hwp_bench.base.errors import BadInput
from hwp_bench.importers.shared.association import associate, hand_of
from hwp_bench.importers.shared.hand_tracks import tracks_of

#: MediaPipe (= OpenPose) order, the order of every landmark array in this package.
LANDMARK_NAMES = (
    "wrist",
    *(f"{finger}_{k}" for finger in ("thumb", "index", "middle", "ring", "little") for k in "1234"),
)
#: Range of a hand's extent, m: from a small child's fist to a large open hand, with a margin.
HAND_METRES = (0.02, 0.5)
#: Pairs of landmarks that a drawing connects.
LANDMARK_EDGES = (
    *((0, 4 * finger + 1) for finger in range(5)),
    *((4 * finger + k, 4 * finger + k + 1) for finger in range(5) for k in (1, 2, 3)),
)


@dataclass(frozen=True)
class Landmarks:
    """Landmarks of one hand in every frame of a video.

    Attributes:
        image: (F, 21, 2) float64, x and y in pixels of the whole frame (centres at +0.5).
        world: (F, 21, 3) float64, metres, x right, y down, z away from the camera; the origin is
            near the hand's centre and the scale is the tracker's guess.
        score: (F,) float64, the tracker's confidence in [0, 1].
        detected: (F,) bool, frames whose landmarks can be used.
    """

    image: np.ndarray
    world: np.ndarray
    score: np.ndarray
    detected: np.ndarray

    def select(self, frames: np.ndarray) -> Landmarks:
        """Return the landmarks of some frames."""
        return Landmarks(
            self.image[frames], self.world[frames], self.score[frames], self.detected[frames]
        )


def read_landmarks(
    path: str | os.PathLike[str], *, min_score: float, side: str | None = None
) -> Landmarks:
    """Read a tracker's npz file.

    Args:
        path: npz with `image` (F, 21, 2 or 3), `world` (F, 21, 3) and `score` (F,). A frame in
            which the tracker saw nothing has score 0; its landmarks may be NaN.
        min_score: frames below this score count as not detected.
        side: `right` or `left`: the hand that is read where the file has several (version 2) and
            one is of this side; else that which is seen most. Hands that the tracker exchanged
            are put right (`associate`).

    Returns:
        The landmarks; values of frames that are not detected are zero.

    Raises:
        BadInput: the file is missing, not an npz, too large, holds objects or the wrong shapes, has
            no detected frame, is not in metres, or has NaN where the score is that of a visible
            hand.
    """
    path = Path(path)
    arrays = _load(path, side)
    image, world, score = (_floats(path, arrays, name) for name in ("image", "world", "score"))
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
            remedy="Track a hand first, or lower --min-score.",
        )
    _check_metres(path, world[detected])
    usable = detected[:, None, None]
    return Landmarks(np.where(usable, image, 0.0), np.where(usable, world, 0.0), score, detected)


def _check_metres(path: Path, world: np.ndarray) -> None:
    extent = np.median(np.ptp(world, axis=1).max(axis=1))
    low, high = HAND_METRES
    if not low <= extent <= high:
        raise BadInput(
            f"spans {extent:.3g} in a typical frame, which is not a hand in metres",
            where=path,
            field="world",
            remedy=f"World landmarks are metres; a hand spans {low:g} to {high:g}.",
        )


def check_against_video(
    landmarks: Landmarks, frame_count: int, width: int, height: int, where: str | os.PathLike[str]
) -> Landmarks:
    """Check the landmarks against the video that they were tracked in.

    Returns:
        The landmarks; frames are marked as not detected whose hand lies completely outside
        the image, leaves it by more than the image's size, or is smaller than 8 pixels.

    Raises:
        BadInput: the number of frames differs, or no frame is left.
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
    return Landmarks(landmarks.image, landmarks.world, landmarks.score, detected)


def _load(path: Path, side: str | None) -> dict[str, np.ndarray]:
    arrays = read_npz(path)
    tracks = None if side is None else tracks_of(arrays, path)
    tracks = None if tracks is None else associate(tracks).tracks
    hand = None if tracks is None or side is None else hand_of(tracks, side)
    if tracks is not None and hand is not None:
        return {
            "image": tracks.image[hand],
            "world": tracks.world[hand],
            "score": tracks.score[hand],
        }
    missing = [name for name in ("image", "world", "score") if name not in arrays]
    if missing:
        raise BadInput(f"lacks the arrays {', '.join(missing)}", where=path)
    return arrays


def _floats(path: Path, arrays: dict[str, np.ndarray], name: str) -> np.ndarray:
    if arrays[name].dtype.kind not in "fiu":
        raise BadInput(f"holds {arrays[name].dtype}, expected numbers", where=path, field=name)
    return arrays[name].astype(np.float64)
