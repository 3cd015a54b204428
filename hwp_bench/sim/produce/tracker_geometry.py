"""The 21 landmarks of a posed hand, how they move with its joints, and how hard it is to see."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from hwp_bench.hands.skeleton import (
    FINGERS,
    JOINT_NAMES,
    PARENTS,
    finger_joints,
    landmark_order,
)
from hwp_bench.hands.template import HandTemplate

#: Mean bend of a finger joint in a fist, rad: a curl of 1.
FIST = 1.3
#: Parameters that landmarks move with: 16 joints about their own axes, and the translation.
DEGREES = 51
# Landmarks of the wrist and of the knuckles of index, middle and little finger.
_WRIST, _INDEX, _MIDDLE, _LITTLE = 0, 5, 9, 17


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
        turn = views[:, None, :3, :3]
        place = views[:, None, :3, 3]
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
    """Pose a skeleton.

    Args:
        rest: at rest.
        pose: (F, 16, 3) axis-angle rad.
        transl: (F, 3) m.
    """
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


def _moved_by(joint: int) -> list[int]:
    """Landmarks that a joint carries."""
    owners = [*range(16), *(finger_joints(finger)[-1] for finger in FINGERS)]
    carried = []
    for number, row in enumerate(landmark_order()):
        above = owners[row] if row >= 16 else PARENTS[owners[row]]
        while above >= 0 and above != joint:
            above = PARENTS[above]
        if above == joint:
            carried.append(number)
    return carried


def curl(pose: np.ndarray) -> np.ndarray:
    """How far the four fingers are bent: (F,), 0 straight to 1 fist.

    Args:
        pose: (F, 16, 3) axis-angle rad.
    """
    four = [
        row
        for row, name in enumerate(JOINT_NAMES)
        if name != "wrist" and not name.startswith("thumb")
    ]
    bends = np.linalg.norm(pose[:, four], axis=2).mean(axis=1)
    return np.asarray(np.clip(bends / FIST, 0.0, 1.0))


def edge_on(landmarks: np.ndarray) -> np.ndarray:
    """How far a palm is turned from the camera: (F,), 0 facing it or away, 1 seen from its edge.

    Args:
        landmarks: (F, 21, 3) m, camera axes.
    """
    wrist = landmarks[:, _WRIST]
    normal = np.cross(landmarks[:, _INDEX] - wrist, landmarks[:, _LITTLE] - wrist)
    sight = landmarks[:, _MIDDLE]
    length = np.linalg.norm(normal, axis=1) * np.linalg.norm(sight, axis=1)
    return np.asarray(1.0 - np.abs((normal * sight).sum(axis=1)) / np.maximum(length, 1e-12))
