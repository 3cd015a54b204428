"""The directions of a palm, from the skeleton alone."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from hwp_bench.base.errors import BadHandModel
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

    Raises:
        BadHandModel: wrist and knuckles lie on one line.
    """
    index, middle, little = (
        JOINT_NAMES.index(f"{name}1") for name in ("index", "middle", "little")
    )
    ahead, across = joints[middle] - joints[0], joints[index] - joints[little]
    # Less than 0.1 mm x 0.1 mm of palm has no direction worth the name.
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
