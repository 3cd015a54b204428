"""The directions of a palm, from the skeleton alone."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from hwp_bench.hands.landmarks import JOINT_NAMES


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
    """
    index, middle, little = (
        JOINT_NAMES.index(f"{name}1") for name in ("index", "middle", "little")
    )
    forward = unit(joints[middle] - joints[0])
    across = joints[index] - joints[little]
    thumbward = unit(across - (across @ forward) * forward)
    palmar = np.cross(forward, thumbward)
    return PalmDirections(forward, -palmar if side == "right" else palmar, thumbward)


def unit(vector: np.ndarray) -> np.ndarray:
    """(..., 3) vectors scaled to length one."""
    return vector / np.linalg.norm(vector, axis=-1, keepdims=True)
