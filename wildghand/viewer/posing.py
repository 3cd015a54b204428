"""Changes of the hands that are shown: an angle, the shape of the fingers. Functions of state."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping

import numpy as np

from hwp_bench.methods.contract import HandPose
from wildghand.avatar.hand_angles import HandAngles

#: Hands as they are shown, by side.
Hands = Mapping[str, HandPose]


def with_angle(
    hands: Hands, angles: HandAngles, joint: int, angle: int, degrees: float
) -> dict[str, HandPose]:
    """Return hands of which one has another angle; everything else stays.

    Args:
        hands: by side.
        angles: of the hand that changes.
        joint: 0 the wrist, then MANO's order.
        angle: 0 flexion, 1 abduction, 2 twist.
        degrees: cut to the range of the joint.
    """
    hand = hands[angles.side]
    found = angles.angles(hand.pose)
    found[joint, angle] = np.clip(degrees, angles.lower[joint, angle], angles.upper[joint, angle])
    return {**hands, angles.side: dataclasses.replace(hand, pose=angles.pose(found))}


def with_fingers(
    hands: Hands, angles: Mapping[str, HandAngles], named: Mapping[str, np.ndarray]
) -> dict[str, HandPose]:
    """Return hands with other fingers, where they are and as they are turned.

    Args:
        hands: by side.
        angles: of every hand, by side.
        named: (16, 3) degrees by side; the wrist's are left out.
    """
    changed = {}
    for side, hand in hands.items():
        pose = angles[side].pose(named[side])
        pose[0] = hand.pose[0]
        changed[side] = dataclasses.replace(hand, pose=pose)
    return changed


def shown_angles(hand: HandPose, angles: HandAngles) -> np.ndarray:
    """Return the angles of a hand as sliders show them.

    Returns:
        (16, 3) degrees to a tenth, within the ranges: a tracked pose may lie outside of them.
    """
    return np.round(angles.angles(hand.pose), 1).clip(angles.lower, angles.upper)
