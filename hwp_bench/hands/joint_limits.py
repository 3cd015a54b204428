"""How far fingers bend: anatomical ranges, and a penalty for leaving them."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch

from hwp_bench.hands.articulation import FINGER_JOINT_COUNT, joint_angles, joint_axes, rest_flexion
from hwp_bench.hands.landmarks import JOINT_NAMES
from hwp_bench.hands.template import HandTemplate

# Flexion (from a straight finger), abduction and twist (from the rest mesh), in degrees. The
# thumb's first joint has no straight position: its flexion counts from the rest mesh too.
_KNUCKLE = ((-35.0, 95.0), (-25.0, 25.0), (-10.0, 10.0))
_MIDDLE = ((-10.0, 115.0), (-5.0, 5.0), (-5.0, 5.0))
_LAST = ((-20.0, 90.0), (-5.0, 5.0), (-5.0, 5.0))
_RANGES = {
    "thumb1": ((-40.0, 45.0), (-35.0, 40.0), (-20.0, 20.0)),
    "thumb2": ((-20.0, 65.0), (-15.0, 15.0), (-10.0, 10.0)),
    "thumb3": ((-30.0, 90.0), (-5.0, 5.0), (-5.0, 5.0)),
}
_BY_SEGMENT = {"1": _KNUCKLE, "2": _MIDDLE, "3": _LAST}


@dataclass(frozen=True, eq=False)
class JointLimits:
    """Axes and ranges of the 15 finger joints of one template."""

    #: (15, 3, 3) from `joint_axes`.
    axes: np.ndarray
    #: (15, 3) smallest flexion, abduction and twist of a pose, rad; not positive.
    lower: np.ndarray
    #: (15, 3) largest, rad; not negative.
    upper: np.ndarray


def anatomical_limits(template: HandTemplate) -> JointLimits:
    """The ranges of a template's joints, as angles of its poses (zero = rest mesh).

    The rest mesh is always inside its limits.

    Source: Lin, Wu and Huang, "Modeling the Constraints of Human Hand Motion" (2000), widened
    by the hyperextension that healthy adults show.
    """
    ranges = np.deg2rad(
        [_RANGES.get(name, _BY_SEGMENT[name[-1]]) for name in JOINT_NAMES[1:]]
    ).reshape(FINGER_JOINT_COUNT, 3, 2)
    shift = np.zeros((FINGER_JOINT_COUNT, 3, 1))
    shift[:, 0, 0] = rest_flexion(template)
    lower, upper = np.moveaxis(ranges - shift, -1, 0)
    return JointLimits(joint_axes(template), np.minimum(lower, 0.0), np.maximum(upper, 0.0))


def joint_limit_penalty(pose: torch.Tensor, template: HandTemplate | JointLimits) -> torch.Tensor:
    """Squared angles beyond the anatomical ranges, summed over joints and axes.

    Args:
        pose: (B, 16, 3) axis-angle rad; the wrist is free.
        template: the hand, or its `anatomical_limits` where the penalty is taken many times.

    Returns:
        (B,) rad^2, not negative; zero (with zero gradient) inside the ranges, so also in the
        rest pose. Differentiable.
    """
    limits = anatomical_limits(template) if isinstance(template, HandTemplate) else template

    def like_pose(array: np.ndarray) -> torch.Tensor:
        return torch.as_tensor(array, dtype=pose.dtype, device=pose.device)

    angles = joint_angles(pose, like_pose(limits.axes))
    below = (like_pose(limits.lower) - angles).clamp_min(0.0)
    above = (angles - like_pose(limits.upper)).clamp_min(0.0)
    return (below * below + above * above).sum(dim=(1, 2))
