"""Rotation matrices from axis-angle vectors, smooth everywhere."""

from __future__ import annotations

import numpy as np
import torch

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
    sine_ratio = torch.where(small, _sine_series(series_of), torch.sin(angle) / angle)
    cosine_ratio = torch.where(
        small, _cosine_series(series_of), 2.0 * half_sine * half_sine / closed_of
    )
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


def _sine_series(squared: torch.Tensor) -> torch.Tensor:
    term = 1.0 - squared / 72.0
    for denominator in (42.0, 20.0, 6.0):
        term = 1.0 - squared / denominator * term
    return term


def _cosine_series(squared: torch.Tensor) -> torch.Tensor:
    term = 1.0 - squared / 90.0
    for denominator in (56.0, 30.0, 12.0):
        term = 1.0 - squared / denominator * term
    return 0.5 * term


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

    Args:
        matrix: (..., 3, 3) rotation matrices.

    Returns:
        (..., 3) rad, of length at most pi; differentiable short of half a turn.

    Source: the quaternion is the largest of its four algebraically equal forms (Shepperd).
    """
    diagonal = matrix.diagonal(dim1=-2, dim2=-1)
    x, y, z = diagonal.unbind(dim=-1)
    skew = torch.stack(
        [
            matrix[..., 2, 1] - matrix[..., 1, 2],
            matrix[..., 0, 2] - matrix[..., 2, 0],
            matrix[..., 1, 0] - matrix[..., 0, 1],
        ],
        dim=-1,
    )
    # 4 q q^T: each row is the quaternion (w, x, y, z) times four of its own entries.
    symmetric = matrix + matrix.mT
    off = [symmetric[..., 0, 1], symmetric[..., 0, 2], symmetric[..., 1, 2]]
    trace = x + y + z
    rows = [
        torch.stack([1.0 + trace, skew[..., 0], skew[..., 1], skew[..., 2]], dim=-1),
        torch.stack([skew[..., 0], 1.0 + 2.0 * x - trace, off[0], off[1]], dim=-1),
        torch.stack([skew[..., 1], off[0], 1.0 + 2.0 * y - trace, off[2]], dim=-1),
        torch.stack([skew[..., 2], off[1], off[2], 1.0 + 2.0 * z - trace], dim=-1),
    ]
    products = torch.stack(rows, dim=-2)
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
