"""The proportions of a hand: how long its bones are, how thick its fingers, how large its palm.

People differ in these most, and an outline tells them badly point by point: a finger that is longer
shows at its tip alone. So each is one number that moves surface and joints together.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from hwp_bench.hands import HandTemplate
from hwp_bench.hands.skeleton import (
    FINGERS,
    JOINT_COUNT,
    finger_joints,
    moved_joints,
    palm_directions,
)
from wildghand.subject.shape import side_flip


@dataclass(frozen=True, eq=False)
class Proportions:
    """S numbers, each a change relative to the template's, and how they move its right hand.

    They are the lengths of the 15 bones of the fingers, the thicknesses of their 15 segments, and
    length, width and thickness of the palm.
    """

    #: (V, 3, S) m that each rest vertex moves for a change by all of itself.
    vertices: np.ndarray
    #: (16, 3, S) m that each rest joint moves.
    joints: np.ndarray
    #: (S,) bool: the number is a length of a bone or of the palm, and no thickness.
    lengths: np.ndarray


def hand_proportions(template: HandTemplate) -> Proportions:
    """The proportions of a template.

    Args:
        template: the hand, of either side.
    """
    moves: list[tuple[np.ndarray, np.ndarray, bool]] = []
    below = moved_joints()
    for finger, name in enumerate(FINGERS):
        chain = finger_joints(name)
        ends = [*template.joints[list(chain)], template.vertices[template.fingertips[finger]]]
        for step, joint in enumerate(chain):
            bone = ends[step + 1] - ends[step]
            along = (template.vertices - ends[step]) @ bone / (bone @ bone)
            # Skin around a bone is stretched with it, and what is beyond it moves on with its end.
            carried = template.weights @ below[joint] * np.clip(along, 0.0, 1.0)
            after = below[joint].copy()
            after[joint] = 0.0
            moves.append((carried[:, None] * bone, after[:, None] * bone, True))
            aside = template.vertices - ends[step] - along[:, None] * bone
            own = template.weights[:, joint, None]
            moves.append((own * aside, np.zeros((JOINT_COUNT, 3)), False))
    wrist = template.joints[0]
    directions = palm_directions(template.joints, template.side)
    for axis in (directions.forward, directions.thumbward, directions.palmar):
        # The palm is scaled about the wrist; a finger goes where its first joint goes.
        joints = np.outer((template.joints - wrist) @ axis, axis)
        for name in FINGERS:
            first, *others = finger_joints(name)
            joints[others] = joints[first]
        surface = template.weights[:, :1] * np.outer((template.vertices - wrist) @ axis, axis)
        moves.append((surface + template.weights[:, 1:] @ joints[1:], joints, True))
    flip = side_flip(template.side)[:, None]
    return Proportions(
        vertices=np.stack([move[0] for move in moves], axis=-1) * flip,
        joints=np.stack([move[1] for move in moves], axis=-1) * flip,
        lengths=np.array([move[2] for move in moves]),
    )
