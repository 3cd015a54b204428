"""How hands move around a frame, and how far that is in the image."""

from __future__ import annotations

import math

import numpy as np
import torch


def nearest_turn(pose: np.ndarray, to: np.ndarray) -> np.ndarray:
    """The axis-angle vectors of the same rotations that are nearest to given ones.

    A rotation by t about an axis is one by t - 2 pi too; near half a turn a tracker may jump
    between the two.
    """
    angle = np.linalg.norm(pose, axis=-1, keepdims=True)
    axis = pose / np.where(angle > 0.0, angle, 1.0)
    candidates = np.stack([pose, pose - 2.0 * math.pi * axis])
    choice = np.linalg.norm(candidates - to, axis=-1, keepdims=True).argmin(axis=0)
    return np.take_along_axis(candidates, choice[None], axis=0)[0]


def velocities(
    values: np.ndarray, valid: np.ndarray, indices: np.ndarray, *, turns: bool = False
) -> np.ndarray:
    """Change of numbers from frame to frame by the difference of the valid neighbours.

    Args:
        values: (F, ..., C) of every frame of a clip.
        valid: (F,) bool.
        indices: (R,) valid frames.
        turns: they are axis-angle vectors, whose jumps by a whole turn are none.

    Returns:
        (R, ..., C) per frame; from one side where the other is missing, 0 where both are.
    """
    last = len(values) - 1
    before = indices - ((indices > 0) & valid[indices - 1])
    after = indices + ((indices < last) & valid[np.minimum(indices + 1, last)])
    first, second = values[before], values[after]
    if turns:
        first, second = (nearest_turn(pose, values[indices]) for pose in (first, second))
    steps = np.maximum(after - before, 1)
    return (second - first) / steps.reshape(-1, *[1] * (values.ndim - 1))


def motion_px(
    start: torch.Tensor, end: torch.Tensor, viewmats: torch.Tensor, Ks: torch.Tensor
) -> torch.Tensor:
    """How far points (B, N, 3) in the world move in the image, (B,) px; 0 behind the camera.

    It is the distance that a twentieth of them exceeds.
    """
    places = []
    for points in (start, end):
        seen = points @ viewmats[:, :3, :3].mT + viewmats[:, None, :3, 3]
        on_image = seen @ Ks.mT
        places.append(on_image[..., :2] / on_image[..., 2:].clamp(min=1e-6))
        places[-1] = torch.where(seen[..., 2:] > 0.0, places[-1], 0.0)
    return (places[1] - places[0]).norm(dim=-1).quantile(0.95, dim=1)
