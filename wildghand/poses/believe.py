"""The corrected poses of a clip: the given ones, less their probable errors."""

from __future__ import annotations

import functools
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Annotated

import numpy as np

from hwp_bench.base.arrays import evenly
from hwp_bench.capture import Cameras
from hwp_bench.hands import HandParameters, HandPose, HandTemplate
from hwp_bench.hands.articulation import right_jacobian
from hwp_bench.hands.poses import turned
from wildghand.gaussians.found import Found, Kept
from wildghand.poses.errors import (
    error_size,
    extent_in,
    in_front,
    pose_covariances,
    spread_of,
    vector_changes,
)

# Largest number that is read, as in a capture, rad or m.
_LARGEST = 1e6
# What a correction changes of a hand.
_POSED = ("pose", "transl")
_Tables = Annotated[Mapping[str, np.ndarray], Kept(("F", 51), -_LARGEST, _LARGEST)]


@dataclass(frozen=True, eq=False)
class ClipPoses(Found):
    """Poses of the frames of a clip by side, (F, 51) float32: 16 axis-angle vectors and transl.

    A pose counts as one of the clip if all of its numbers are equal; other poses are not changed.
    """

    prefix = "poses_"
    given: _Tables
    believed: _Tables

    @functools.cached_property
    def _rows(self) -> dict[str, dict[bytes, int]]:
        """The row of each given pose that was changed, by side.

        A frame without the hand may hold the pose of one with it, and is drawn as that one.
        """
        return {
            side: {
                row.tobytes(): number
                for number, row in enumerate(poses)
                if not np.array_equal(row, self.believed[side][number])
            }
            for side, poses in self.given.items()
        }

    @classmethod
    def of(
        cls, given: Mapping[str, HandParameters], believed: Mapping[str, HandParameters]
    ) -> ClipPoses | None:
        """Compare given and corrected hands; None if all are the same."""
        changed = [side for side in given if believed[side] is not given[side]]
        if not changed:
            return None
        return cls(
            {side: _numbers(given[side].pose, given[side].transl) for side in changed},
            {side: _numbers(believed[side].pose, believed[side].transl) for side in changed},
        )

    def corrected(self, hands: Mapping[str, HandPose]) -> dict[str, HandPose]:
        """The hands; a pose of the clip is replaced by the corrected one."""
        return {side: self._corrected(side, hand) for side, hand in hands.items()}

    def corrected_clip(self, hands: Mapping[str, HandParameters]) -> dict[str, HandParameters]:
        """The hands of a clip; poses of this one are replaced by the corrected ones."""
        made = {}
        for side, hand in hands.items():
            found = [self._corrected(side, hand.at(row, side)) for row in range(hand.frame_count)]
            pose, transl = (np.stack([getattr(one, name) for one in found]) for name in _POSED)
            made[side] = replace(hand, pose=pose, transl=transl)
        return made

    def _corrected(self, side: str, hand: HandPose) -> HandPose:
        numbers = _numbers(hand.pose[None], hand.transl[None])[0]
        row = self._rows.get(side, {}).get(numbers.tobytes())
        if row is None:
            return hand
        numbers = self.believed[side][row].astype(np.float64)
        return replace(hand, pose=numbers[:48].reshape(16, 3), transl=numbers[48:])


def _numbers(pose: np.ndarray, transl: np.ndarray) -> np.ndarray:
    """Poses (F, 16, 3) and translations (F, 3) as rows of float32, without negative zeros."""
    rows = np.concatenate([pose.reshape(len(pose), -1), transl], axis=1)
    return rows.astype(np.float32) + np.float32(0.0)


#: Frames at most from which the spread of poses is learnt, evenly spread over the clip.
FRAMES = 240
#: Errors below this, rad (root mean square of finger joints), are left alone.
LEAST_ERROR = 0.01
# Joints and numbers of the fingers; the wrist and the place are what is left of 51.
_FINGERS = slice(3, 48)
_OTHERS = [0, 1, 2, 48, 49, 50]
# Rounds in which the spread of the true poses is found; it hardly moves after.
_ROUNDS = 10
# Frames that are corrected at once, which bounds the memory.
_CHUNK = 1024


def believed_hands(
    templates: Mapping[str, HandTemplate],
    hands: Mapping[str, HandParameters],
    cameras: Cameras,
    exact: np.ndarray | None = None,
) -> dict[str, HandParameters]:
    """Correct the given poses of a clip by what they have in common.

    A hand moves in few ways, and an estimator errs in all. How the clip's poses spread and how much
    they err is found from the given poses of all frames; no picture is read.

    Args:
        exact: (F,) bool, frames whose poses are true: they stay, and say how true poses spread.
            None: none.
    """
    if exact is None:
        exact = np.zeros(len(cameras.viewmats), dtype=bool)
    return {
        side: _believed(templates[side], hand, cameras.viewmats, exact)
        for side, hand in hands.items()
    }


def _believed(
    template: HandTemplate, hand: HandParameters, viewmats: np.ndarray, exact: np.ndarray
) -> HandParameters:
    valid = np.flatnonzero(hand.valid & in_front(template, hand, viewmats))
    true, erring = valid[exact[valid]], valid[~exact[valid]]
    some = erring[evenly(len(erring), FRAMES)]
    if len(some) <= _FINGERS.stop - _FINGERS.start:
        return hand
    extent = extent_in(template, _rows(hand, valid), viewmats[valid])

    def covariances(rows: np.ndarray) -> np.ndarray:
        return pose_covariances(template, _rows(hand, rows), viewmats[rows], extent)

    poses, errors = _in_vectors(_rows(hand, some), covariances(some))
    size = error_size(poses, errors)
    mean_square = np.trace(errors, axis1=1, axis2=2).mean() / errors.shape[1]
    if size * np.sqrt(mean_square) < LEAST_ERROR:
        return hand
    if len(true):
        known = _shortest(_rows(hand, true[evenly(len(true), FRAMES)])).reshape(-1, 45)
        poses = np.concatenate([poses, known])
        errors = np.concatenate([errors, np.zeros((len(known), 45, 45))])
    spread = spread_of(poses, size**2 * errors, _ROUNDS)
    pose, transl = hand.pose.copy(), hand.transl.copy()
    for start in range(0, len(erring), _CHUNK):
        rows = erring[start : start + _CHUNK]
        given = _rows(hand, rows)
        together = size**2 * covariances(rows)
        poses, errors = _in_vectors(given, together)
        change = spread.expected(poses, errors) - poses
        turn = (right_jacobian(_shortest(given)) @ change.reshape(-1, 15, 3, 1))[..., 0]
        moved = _along(together, turn.reshape(len(rows), -1))
        turns = np.concatenate([moved[:, None, :3], turn], axis=1)
        pose[rows] = turned(given.pose, turns)
        transl[rows] = given.transl + np.einsum("fba,fb->fa", viewmats[rows, :3, :3], moved[:, 3:])
    return replace(hand, pose=pose, transl=transl)


def _rows(hand: HandParameters, rows: np.ndarray) -> HandParameters:
    """The parameters in some frames."""
    return replace(hand, pose=hand.pose[rows], transl=hand.transl[rows], valid=hand.valid[rows])


def _in_vectors(hand: HandParameters, together: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Rotation vectors of the fingers (F, 45), and covariances of their errors (F, 45, 45).

    Args:
        together: (F, 51, 51) covariances about the joints' own axes.
    """
    vectors = _shortest(hand)
    frames, changes = len(vectors), vector_changes(vectors)
    parts = together[:, _FINGERS, _FINGERS].reshape(frames, 15, 3, 15, 3)
    errors = np.einsum("fiab,fibjc,fjdc->fiajd", changes, parts, changes, optimize=True)
    return vectors.reshape(frames, 45), errors.reshape(frames, 45, 45)


def _shortest(hand: HandParameters) -> np.ndarray:
    """(F, 15, 3) rad, the rotation vectors of the fingers without whole turns."""
    from scipy.spatial.transform import Rotation

    vectors = hand.pose[:, 1:]
    return np.asarray(Rotation.from_rotvec(vectors.reshape(-1, 3)).as_rotvec()).reshape(
        vectors.shape
    )


def _along(together: np.ndarray, turn: np.ndarray) -> np.ndarray:
    """How wrist and place move with fingers that turn (F, 45): (F, 6), rad and m.

    An error of the fingers came with one of these, as the covariance (F, 51, 51) says.
    """
    fingers = together[:, _FINGERS, _FINGERS]
    least = 1e-6 * np.trace(fingers, axis1=1, axis2=2) / 45 + 1e-30
    fingers = fingers + least[:, None, None] * np.eye(45)
    weights = np.linalg.solve(fingers, turn[..., None])
    return np.asarray((together[:, _OTHERS, _FINGERS] @ weights)[..., 0])
