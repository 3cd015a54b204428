"""Rotation matrices from axis-angle vectors, smooth everywhere."""

from __future__ import annotations

import torch

# Below this squared angle the series is exact to float64 and the closed form starts to cancel.
_SERIES_BELOW = 1e-2


def axis_angle_to_matrix(axis_angle: torch.Tensor) -> torch.Tensor:
    """Rodrigues' formula with finite value and gradients at every angle, zero included.

    Args:
        axis_angle: (..., 3) rad; float32 or float64, any finite length.

    Returns:
        (..., 3, 3) rotation matrices.

    Source: Rodrigues' rotation formula R = I + a K + b K^2 with a = sin(t) / t and
    b = (1 - cos(t)) / t^2, written in t^2 so that no square root meets zero.
    """
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
    cross = _cross_matrix(axis_angle)
    identity = torch.eye(3, dtype=axis_angle.dtype, device=axis_angle.device)
    outer = axis_angle.unsqueeze(-1) * axis_angle.unsqueeze(-2)
    # K^2 = v v^T - |v|^2 I: one outer product, no matrix product.
    squared_cross = outer - squared[..., None, None] * identity
    return (
        identity
        + sine_ratio[..., None, None] * cross
        + cosine_ratio[..., None, None] * squared_cross
    )


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


def _cross_matrix(vector: torch.Tensor) -> torch.Tensor:
    x, y, z = vector.unbind(dim=-1)
    zero = torch.zeros_like(x)
    return torch.stack([zero, -z, y, z, zero, -x, -y, x, zero], dim=-1).reshape(
        *vector.shape[:-1], 3, 3
    )
