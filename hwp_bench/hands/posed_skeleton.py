"""The joints and 21 landmarks of posed hands, and how landmarks move with the joints."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from hwp_bench.hands.skeleton import FINGERS, PARENTS, finger_joints, landmark_order
from hwp_bench.hands.template import HandTemplate

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


def landmark_rows(
    posed: PosedSkeleton, image_spread: np.ndarray | float, space_spread: np.ndarray | float
) -> np.ndarray:
    """How landmarks move with the parameters, in units of their errors: (F, 105, 51).

    Args:
        posed: in camera axes.
        image_spread: error of each landmark in the image, slopes: (F, 21), or one for all.
        space_spread: error of each in space against the hand's centre, m: (F, 21, 3), or one.

    Returns:
        For each landmark two rows of the image and three of space.
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
    """Median over frames of the larger side of the landmarks' box, in slopes of the camera.

    Args:
        landmarks: (F, 21, 3) m, camera axes.
    """
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
