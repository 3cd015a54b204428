"""A rig's rest pose turned into the hand model's, so that joint angles mean the same on both."""

from __future__ import annotations

import numpy as np

from hwp_bench.hands.skeleton import JOINT_COUNT, PARENTS

# The last bone ends in skin, not in a joint; smaller differences of its direction are not sure.
_UNSURE = np.radians(6.0)


def into_rest_pose(
    vertices: np.ndarray,
    weights: np.ndarray,
    joints: np.ndarray,
    tips: np.ndarray,
    target: np.ndarray,
    target_tips: np.ndarray,
) -> tuple[np.ndarray, np.ndarray]:
    """Turn every finger bone to where the hand model's points, by linear blend skinning.

    Args:
        vertices: (V, 3) m, with the palm aligned already.
        weights: (V, 16).
        joints: (16, 3) m, the rig's.
        tips: (5, 3) m, of thumb, index, middle, ring and little finger.
        target: (16, 3) m, the hand model's.
        target_tips: (5, 3) m.

    Returns:
        (V, 3) vertices and (16, 3) joints; bones keep their lengths.
    """
    ends, target_ends = _bone_ends(joints, tips), _bone_ends(target, target_tips)
    turns = np.tile(np.eye(3), (JOINT_COUNT, 1, 1))
    places = joints.copy()
    for joint in range(1, JOINT_COUNT):
        parent = PARENTS[joint]
        places[joint] = places[parent] + turns[parent] @ (joints[joint] - joints[parent])
        bone = turns[parent] @ (ends[joint] - joints[joint])
        last = joint % 3 == 0
        turns[joint] = (
            _shortest_turn(bone, target_ends[joint] - target[joint], _UNSURE if last else 0.0)
            @ turns[parent]
        )
    moved = np.zeros_like(vertices)
    for joint in range(JOINT_COUNT):
        there = (vertices - joints[joint]) @ turns[joint].T + places[joint]
        moved += weights[:, joint, None] * there
    return moved, places


def _bone_ends(joints: np.ndarray, tips: np.ndarray) -> np.ndarray:
    ends = np.vstack([joints[1:], joints[:1]])
    ends[[15, 3, 6, 12, 9]] = tips
    return ends


def _shortest_turn(start: np.ndarray, end: np.ndarray, unsure: float) -> np.ndarray:
    """Rotation between two directions: (3, 3); none below an angle in rad."""
    from scipy.spatial.transform import Rotation

    axis = np.cross(start, end)
    length = float(np.linalg.norm(axis))
    angle = float(np.arctan2(length, start @ end))
    if length < 1e-15 or angle <= unsure:
        return np.eye(3)
    return Rotation.from_rotvec(axis / length * (angle - unsure)).as_matrix()
