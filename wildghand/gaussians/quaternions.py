"""Unit quaternions (w, x, y, z): the few operations that moving Gaussians along needs."""

from __future__ import annotations

import torch


def quat_multiply(left: torch.Tensor, right: torch.Tensor) -> torch.Tensor:
    """Hamilton product of (..., 4), broadcast: the rotation `right` followed by `left`."""
    aw, ax, ay, az = left.unbind(-1)
    bw, bx, by, bz = right.unbind(-1)
    return torch.stack(
        (
            aw * bw - ax * bx - ay * by - az * bz,
            aw * bx + ax * bw + ay * bz - az * by,
            aw * by - ax * bz + ay * bw + az * bx,
            aw * bz + ax * by - ay * bx + az * bw,
        ),
        dim=-1,
    )


def quat_rotate(quats: torch.Tensor, vectors: torch.Tensor) -> torch.Tensor:
    """Rotate (..., 3) vectors by (..., 4) quaternions of length 1, broadcast.

    Source: v + 2 w (u x v) + 2 u x (u x v), with u the quaternion's vector part.
    """
    axis = quats[..., 1:]
    axis, vectors = torch.broadcast_tensors(axis, vectors)
    twice = 2.0 * torch.linalg.cross(axis, vectors)
    return vectors + quats[..., :1] * twice + torch.linalg.cross(axis, twice)


def quat_third_axis(quats: torch.Tensor) -> torch.Tensor:
    """Where (..., 4) of length 1 take the z axis: the third column of the rotation matrix."""
    w, x, y, z = quats.unbind(-1)
    return torch.stack(
        (2.0 * (x * z + w * y), 2.0 * (y * z - w * x), 1.0 - 2.0 * (x * x + y * y)), dim=-1
    )


def matrix_to_quat(matrices: torch.Tensor) -> torch.Tensor:
    """Unit quaternions of (..., 3, 3) rotations, exact at every angle.

    The largest entry in magnitude is positive. Source: Shepperd, "Quaternion from rotation matrix":
    of the four equivalent formulas the one that divides by the largest entry is taken.
    """
    m = matrices
    xx, yy, zz = m[..., 0, 0], m[..., 1, 1], m[..., 2, 2]
    wx, wy, wz = (
        m[..., 2, 1] - m[..., 1, 2],
        m[..., 0, 2] - m[..., 2, 0],
        m[..., 1, 0] - m[..., 0, 1],
    )
    xy, xz, yz = (
        m[..., 0, 1] + m[..., 1, 0],
        m[..., 0, 2] + m[..., 2, 0],
        m[..., 1, 2] + m[..., 2, 1],
    )
    # Row k holds 4 q_k (w, x, y, z).
    rows = torch.stack(
        (
            torch.stack((1.0 + xx + yy + zz, wx, wy, wz), dim=-1),
            torch.stack((wx, 1.0 + xx - yy - zz, xy, xz), dim=-1),
            torch.stack((wy, xy, 1.0 - xx + yy - zz, yz), dim=-1),
            torch.stack((wz, xz, yz, 1.0 - xx - yy + zz), dim=-1),
        ),
        dim=-2,
    )
    best = torch.diagonal(rows, dim1=-2, dim2=-1).argmax(dim=-1)
    picked = torch.take_along_dim(rows, best[..., None, None], dim=-2).squeeze(-2)
    return torch.nn.functional.normalize(picked, dim=-1)
