"""Poses of a hand as numbers: named shapes, joint angles, and where joints and landmarks go."""

from __future__ import annotations

import tomllib
from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cache
from importlib import resources
from types import MappingProxyType
from typing import TYPE_CHECKING

import numpy as np

from hwp_bench.base.errors import BadInput
from hwp_bench.hands.skeleton import (
    FINGERS,
    PARENTS,
    HandParameters,
    finger_joints,
    landmark_order,
    moved_joints,
)
from hwp_bench.hands.template import HandTemplate

if TYPE_CHECKING:
    from scipy.spatial.transform import Rotation

#: First joint of each finger in MANO's order.
FIRST_JOINT = MappingProxyType({finger: finger_joints(finger)[0] for finger in FINGERS})
#: Lowest and highest angle in degrees for the thumb, then for every other finger.
LIMITS = (
    np.array([[-30.0, 70.0], [-35.0, 45.0], [-20.0, 70.0], [-25.0, 85.0]]),
    np.array([[-30.0, 95.0], [-8.0, 112.0], [-12.0, 85.0], [-25.0, 25.0]]),
)
#: How far a finger closes before it meets the palm: `CLOSING` times its three flexions, degrees,
#: at most `CLOSED`, for index, middle, ring and little finger. Solved with
#: `benchmarks.penetration` for a tip that presses 3 mm into the palm.
CLOSING = np.array([0.9, 1.0, 0.3])
CLOSED = np.array([140.0, 153.0, 150.0, 135.0])


@cache
def gestures() -> Mapping[str, np.ndarray]:
    """Return the named hand shapes: (5, 4) degrees each, rows in the order of `FINGERS`."""
    text = resources.files("hwp_bench.hands").joinpath("data", "gestures.toml").read_text("utf-8")
    return MappingProxyType(
        {
            name: np.array([shape[finger] for finger in FINGERS], dtype=np.float64)
            for name, shape in tomllib.loads(text).items()
        }
    )


def gesture(name: str) -> np.ndarray:
    """Look a hand shape up."""
    try:
        return gestures()[name]
    except KeyError:
        known = ", ".join(gestures())
        raise BadInput(
            f"there is no gesture {name!r}", field="gesture", remedy=f"Known: {known}."
        ) from None


def finger_back(finger: str) -> np.ndarray:
    """Unit vector that the back of a finger faces on the right hand at rest."""
    return np.array([0.2, 0.62, 0.76]) if finger == "thumb" else np.array([0.0, 1.0, 0.0])


def within_limits(angles: np.ndarray) -> np.ndarray:
    """Clip (..., 5, 4) degrees to what a hand can do.

    A finger that would close into the palm keeps the proportions of its flexions and stops where
    it touches.
    """
    thumb = np.clip(angles[..., :1, :], LIMITS[0][:, 0], LIMITS[0][:, 1])
    rest = np.clip(angles[..., 1:, :], LIMITS[1][:, 0], LIMITS[1][:, 1])
    closing = np.maximum(rest[..., :3] @ CLOSING, 1e-9)
    rest[..., :3] *= np.minimum(1.0, CLOSED / closing)[..., None]
    return np.concatenate([thumb, rest], axis=-2)


def finger_pose(angles: np.ndarray, joints: np.ndarray) -> np.ndarray:
    """Turn anatomical angles into axis-angle vectors of the *right* hand.

    Args:
        angles: (5, 4) degrees, rows in the order of `FINGERS`, columns as `gestures.toml` says.
        joints: (16, 3) rest joints of the right hand, m.

    Returns:
        (15, 3) axis-angle rad, joints 1-15 in MANO's order. The left hand's pose is
        (x, -y, -z) of it.
    """
    from scipy.spatial.transform import Rotation

    angles = np.radians(within_limits(np.asarray(angles, dtype=np.float64)))
    pose = np.zeros((16, 3))
    for row, finger in enumerate(FINGERS):
        first = finger_joints(finger)[0]
        bones = np.diff(joints[first : first + 3], axis=0)
        bones = np.vstack([bones, bones[-1]])
        bones /= np.linalg.norm(bones, axis=1, keepdims=True)
        axes = np.cross(finger_back(finger), bones)
        axes /= np.linalg.norm(axes, axis=1, keepdims=True)
        a, b, c, d = angles[row]
        if finger == "thumb":
            base = Rotation.from_rotvec([a, 0, 0]) * Rotation.from_rotvec([0, -b, 0])
            pose[first] = base.as_rotvec()
            pose[first + 1] = axes[1] * c
            pose[first + 2] = axes[2] * d
        else:
            # About +y the finger, which points along -x, swings to the thumb's side (+z).
            base = Rotation.from_rotvec([0, d, 0]) * Rotation.from_rotvec(axes[0] * a)
            pose[first] = base.as_rotvec()
            pose[first + 1] = axes[1] * b
            pose[first + 2] = axes[2] * c
    return pose[1:]


def mirrored(pose: np.ndarray) -> np.ndarray:
    """The same pose on the other hand: (x, -y, -z), joint by joint."""
    return pose * np.array([1.0, -1.0, -1.0])


#: Parameters that landmarks move with: 16 joints about their own axes, and the translation.
DEGREES = 51


@dataclass(frozen=True, eq=False)
class RestSkeleton:
    """Joints and finger tips of a hand at rest, with its shape."""

    #: (16, 3) m.
    joints: np.ndarray
    #: (5, 3) m, thumb to little finger.
    tips: np.ndarray


@dataclass(frozen=True, eq=False)
class PosedSkeleton:
    """Landmarks of a hand in F frames."""

    #: (F, 16, 3, 3) from the rest axes of each joint to the world.
    turns: np.ndarray
    #: (F, 16, 3) m.
    joints: np.ndarray
    #: (F, 21, 3) m, in MediaPipe's order.
    landmarks: np.ndarray

    def seen_by(self, views: np.ndarray) -> PosedSkeleton:
        """The same in the axes of cameras (F, 4, 4)."""
        turn, place = views[:, None, :3, :3], views[:, None, :3, 3]
        return PosedSkeleton(
            turns=turn @ self.turns,
            joints=(turn @ self.joints[..., None])[..., 0] + place,
            landmarks=(turn @ self.landmarks[..., None])[..., 0] + place,
        )


def rest_skeleton(model: HandTemplate, betas: np.ndarray) -> RestSkeleton:
    """Joints and tips of a hand model with a shape (10,)."""
    tips = np.asarray(model.fingertips)
    return RestSkeleton(
        joints=model.joints + model.joint_basis @ betas,
        tips=model.vertices[tips] + model.shape_basis[tips] @ betas,
    )


def posed_skeleton(rest: RestSkeleton, pose: np.ndarray, transl: np.ndarray) -> PosedSkeleton:
    """Pose a skeleton: (F, 16, 3) axis-angle rad, and (F, 3) m."""
    from scipy.spatial.transform import Rotation

    frames = len(pose)
    own = Rotation.from_rotvec(pose.reshape(-1, 3)).as_matrix().reshape(frames, 16, 3, 3)
    turns, places = np.empty_like(own), np.empty((frames, 16, 3))
    for joint, parent in enumerate(PARENTS):
        if parent < 0:
            turns[:, joint], places[:, joint] = own[:, joint], rest.joints[joint] + transl
            continue
        turns[:, joint] = turns[:, parent] @ own[:, joint]
        bone = rest.joints[joint] - rest.joints[parent]
        places[:, joint] = places[:, parent] + turns[:, parent] @ bone
    last = [finger_joints(finger)[-1] for finger in FINGERS]
    bones = rest.tips - rest.joints[last]
    tips = places[:, last] + np.einsum("fjab,jb->fja", turns[:, last], bones)
    return PosedSkeleton(turns, places, np.concatenate([places, tips], axis=1)[:, landmark_order()])


def movement(posed: PosedSkeleton) -> np.ndarray:
    """How landmarks move: (F, 21, 3, 51), m per rad of each joint about its own axes and per m."""
    frames = len(posed.turns)
    moves = np.zeros((frames, 21, 3, DEGREES))
    for joint in range(16):
        mine = _moved_by(joint)
        arms = posed.landmarks[:, mine] - posed.joints[:, None, joint]
        for axis in range(3):
            about = posed.turns[:, None, joint, :, axis]
            moves[..., 3 * joint + axis][:, mine] = np.cross(about, arms)
    moves[..., 48:] = np.eye(3)
    return moves


def landmark_rows(
    posed: PosedSkeleton, image_spread: np.ndarray | float, space_spread: np.ndarray | float
) -> np.ndarray:
    """How landmarks move with the parameters, in units of their errors: (F, 105, 51).

    Errors are those in the image, slopes: (F, 21), and in space against the hand's centre, m:
    (F, 21, 3), or one for all.
    """
    moves, points = movement(posed), posed.landmarks
    depth = points[..., 2]
    slopes = moves[..., :2, :] - points[..., :2, None] / depth[..., None, None] * moves[..., 2:, :]
    in_image = slopes / depth[..., None, None]
    in_space = moves - moves.mean(axis=1, keepdims=True)
    image, space = np.asarray(image_spread), np.asarray(space_spread)
    rows = [in_image / image[..., None, None], in_space / space[..., None]]
    return np.concatenate(rows, axis=2).reshape(len(points), -1, DEGREES)


def hand_extent(landmarks: np.ndarray) -> float:
    """Median over frames of the larger side of the box of landmarks (F, 21, 3), in slopes."""
    slopes = landmarks[..., :2] / landmarks[..., 2:]
    return float(np.median((slopes.max(axis=1) - slopes.min(axis=1)).max(axis=1)))


def turned(pose: np.ndarray, turn: np.ndarray) -> np.ndarray:
    """Rotation vectors (F, 16, 3) followed by small turns about their own axes.

    Of the two vectors of a rotation the one near `pose` is taken, so that nothing jumps.
    """
    from scipy.spatial.transform import Rotation

    before = Rotation.from_rotvec(pose.reshape(-1, 3))
    vectors = (before * Rotation.from_rotvec(turn.reshape(-1, 3))).as_rotvec().reshape(pose.shape)
    angles = np.linalg.norm(vectors, axis=-1, keepdims=True)
    other = vectors * (1.0 - 2.0 * np.pi / np.maximum(angles, 1e-9))
    nearer = np.linalg.norm(other - pose, axis=-1) < np.linalg.norm(vectors - pose, axis=-1)
    return np.where(nearer[..., None], other, vectors)


def interpolate(values: np.ndarray, seen: np.ndarray, count: int) -> np.ndarray:
    """Fill values (S, ...) of frames `seen`, ascending, to (F, ...): linearly, ends held."""
    flat = values.reshape(len(seen), -1)
    columns = [np.interp(np.arange(count), seen, column) for column in flat.T]
    return np.stack(columns, axis=1).reshape(count, *values.shape[1:])


def interpolate_turns(known: Rotation, seen: np.ndarray, count: int) -> Rotation:
    """Fill S rotations of frames `seen`, ascending, to F: the shortest way (slerp), ends held."""
    from scipy.spatial.transform import Slerp

    if len(seen) == 1:
        return known[np.zeros(count, int)]
    return Slerp(seen, known)(np.arange(count).clip(seen[0], seen[-1]))


def filled(hand: HandParameters) -> HandParameters:
    """Interpolate the parameters of frames that are not valid, so that the hand can be drawn there.

    Valid frames, and which these are, stay as they are.
    """
    from scipy.spatial.transform import Rotation

    seen, count = np.flatnonzero(hand.valid), hand.frame_count
    if len(seen) in (0, count):
        return hand
    pose, transl = hand.pose.copy(), hand.transl.copy()
    lost = ~hand.valid
    for joint in range(pose.shape[1]):
        known = Rotation.from_rotvec(hand.pose[seen, joint])
        pose[lost, joint] = interpolate_turns(known, seen, count)[lost].as_rotvec()
    transl[lost] = interpolate(hand.transl[seen], seen, count)[lost]
    return replace(hand, pose=pose, transl=transl)


def _moved_by(joint: int) -> np.ndarray:
    """Landmarks that a joint carries."""
    below = moved_joints()[joint] > 0
    tips = below[[finger_joints(finger)[-1] for finger in FINGERS]]
    below[joint] = False
    return np.flatnonzero(np.concatenate([below, tips])[list(landmark_order())])
