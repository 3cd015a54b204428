"""The joints of a hand: their order, their tree, and the 21 landmarks of hand trackers."""

from __future__ import annotations

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
