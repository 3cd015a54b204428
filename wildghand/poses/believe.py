"""The poses that a fit believes in: the given ones, less what they probably err by."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from hwp_bench.base.arrays import evenly
from hwp_bench.capture import Cameras
from hwp_bench.hands import HandParameters, HandTemplate
from hwp_bench.hands.articulation import right_jacobian
from hwp_bench.hands.poses import turned
from wildghand.poses.landmark_errors import (
    extent_in,
    in_front,
    pose_covariances,
    vector_changes,
)
from wildghand.poses.settings import PoseSettings
from wildghand.poses.spread import error_size, spread_of

# Joints and numbers of the fingers; the wrist and the place are what is left of 51.
_FINGERS = slice(3, 48)
_OTHERS = [0, 1, 2, 48, 49, 50]
# Frames that are corrected at once, which bounds the memory.
_CHUNK = 1024


def believed_hands(
    templates: Mapping[str, HandTemplate],
    hands: Mapping[str, HandParameters],
    cameras: Cameras,
    settings: PoseSettings,
) -> dict[str, HandParameters]:
    """Correct the given poses of a clip by what they have in common.

    A hand moves in few ways, and an estimator errs in all. How the clip's poses spread and how much
    they err is found from the given poses of all frames; no picture is read.

    Args:
        templates: by side.
        hands: given parameters of every frame, by side.
        cameras: of every frame.
        settings: how.

    Returns:
        The parameters by side: fingers as expected from both, the wrist and the place moved along,
        so that the hand stays on its landmarks. A hand whose errors cannot be told, or are small,
        is the given one.
    """
    return {
        side: _believed(templates[side], hand, cameras.viewmats, settings)
        for side, hand in hands.items()
    }


def _believed(
    template: HandTemplate, hand: HandParameters, viewmats: np.ndarray, settings: PoseSettings
) -> HandParameters:
    valid = np.flatnonzero(hand.valid & in_front(template, hand, viewmats))
    some = valid[evenly(len(valid), settings.frames)]
    if len(some) <= _FINGERS.stop - _FINGERS.start:
        return hand
    extent = extent_in(template, _rows(hand, valid), viewmats[valid])

    def covariances(rows: np.ndarray) -> np.ndarray:
        return pose_covariances(template, _rows(hand, rows), viewmats[rows], extent, settings)

    poses, errors = _in_vectors(_rows(hand, some), covariances(some))
    size = error_size(poses, errors)
    mean_square = np.trace(errors, axis1=1, axis2=2).mean() / errors.shape[1]
    if size * np.sqrt(mean_square) < settings.least_error:
        return hand
    spread = spread_of(poses, size**2 * errors, settings.rounds)
    pose, transl = hand.pose.copy(), hand.transl.copy()
    for start in range(0, len(valid), _CHUNK):
        rows = valid[start : start + _CHUNK]
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
        hand: F frames.
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
