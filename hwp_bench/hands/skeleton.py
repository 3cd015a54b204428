"""The skeleton of a hand: joints and their tree, 21 landmarks, directions of the palm."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from hwp_bench.base.errors import BadHandModel

#: Joint names in MANO's order, which every template here uses.
JOINT_NAMES = (
    "wrist",
    "index1",
    "index2",
    "index3",
    "middle1",
    "middle2",
    "middle3",
    "little1",
    "little2",
    "little3",
    "ring1",
    "ring2",
    "ring3",
    "thumb1",
    "thumb2",
    "thumb3",
)
#: Parent of each joint; the wrist is the root (-1).
PARENTS = (-1, 0, 1, 2, 0, 4, 5, 0, 7, 8, 0, 10, 11, 0, 13, 14)
#: Fingers in the order of `HandTemplate.fingertips`.
FINGERS = ("thumb", "index", "middle", "ring", "little")
#: Side names; the right hand is the one that templates are built from.
SIDES = ("right", "left")
# Rows of [16 joints, 5 tips] in OpenPose order: wrist, then thumb to little, base to tip.
_LANDMARKS = (0, 13, 14, 15, 16, 1, 2, 3, 17, 4, 5, 6, 18, 10, 11, 12, 19, 7, 8, 9, 20)


def landmark_order() -> tuple[int, ...]:
    """Rows of [16 joints, 5 finger tips] that make the 21 landmarks of OpenPose and MediaPipe.

    Returns:
        21 indices: `concatenate([joints, tips])[landmark_order()]` is wrist, thumb (4), index
        (4), middle (4), ring (4), little (4), each finger from its base to its tip.

    Source: the 21-point hand of OpenPose, which MediaPipe and InterHand's users share.
    """
    return _LANDMARKS


def finger_joints(finger: str) -> tuple[int, int, int]:
    """The three joints of a finger, base to tip.

    Args:
        finger: one of `FINGERS`.
    """
    first = JOINT_NAMES.index(f"{finger}1")
    return first, first + 1, first + 2


def moved_joints() -> np.ndarray:
    """(16, 16) float64: 1 where the second joint is the first one or moves with it, else 0."""
    below = np.eye(len(PARENTS))
    for joint in range(len(PARENTS) - 1, 0, -1):
        below[PARENTS[joint]] = np.maximum(below[PARENTS[joint]], below[joint])
    return below


@dataclass(frozen=True, eq=False)
class PalmDirections:
    """Three unit vectors (3,), perpendicular to each other."""

    #: From the wrist to the knuckles.
    forward: np.ndarray
    #: Out of the palm, the way the fingers close.
    palmar: np.ndarray
    #: From the little finger's side to the thumb's.
    thumbward: np.ndarray


def palm_directions(joints: np.ndarray, side: str) -> PalmDirections:
    """Find the directions of a hand's palm.

    Args:
        joints: (16, 3) rest joints, MANO order.
        side: "right" or "left"; the palm of one is the back of the other.

    Raises:
        BadHandModel: wrist and knuckles lie on one line.
    """
    index, middle, little = (
        JOINT_NAMES.index(f"{name}1") for name in ("index", "middle", "little")
    )
    ahead, across = joints[middle] - joints[0], joints[index] - joints[little]
    # Less than 0.1 mm x 0.1 mm of palm has no usable direction.
    if np.linalg.norm(np.cross(ahead, across)) < 1e-8:
        raise BadHandModel("the wrist and the knuckles lie on one line", field="joints")
    forward = unit(ahead)
    thumbward = unit(across - (across @ forward) * forward)
    palmar = np.cross(forward, thumbward)
    return PalmDirections(forward, -palmar if side == "right" else palmar, thumbward)


def unit(vectors: np.ndarray) -> np.ndarray:
    """(..., 3) vectors scaled to length one.

    Raises:
        BadHandModel: a vector has no direction, because joints or segments coincide.
    """
    length = np.linalg.norm(vectors, axis=-1, keepdims=True)
    if length.min() < 1e-9:
        raise BadHandModel(
            "two joints, or a finger and the palm's normal, coincide", field="joints"
        )
    return vectors / length
