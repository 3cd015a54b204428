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


def velocities(values: np.ndarray, valid: np.ndarray, indices: np.ndarray) -> np.ndarray:
    """Change of numbers from frame to frame by the difference of the valid neighbours.

    Args:
        values: (F, ..., C) of every frame of a clip.
        valid: (F,) bool.
        indices: (R,) valid frames.

    Returns:
        (R, ..., C) per frame; from one side where the other is missing, 0 where both are.
    """
    made = np.zeros_like(values[indices])
    for row, frame in enumerate(indices.tolist()):
        before, after = frame, frame
        if frame > 0 and valid[frame - 1]:
            before = frame - 1
        if frame + 1 < len(values) and valid[frame + 1]:
            after = frame + 1
        if after > before:
            made[row] = (values[after] - values[before]) / (after - before)
    return made


def pose_velocities(pose: np.ndarray, valid: np.ndarray, indices: np.ndarray) -> np.ndarray:
    """`velocities` of axis-angle vectors, free of jumps by a whole turn.

    Args:
        pose: (F, J, 3) rad.

    Returns:
        (R, J, 3) rad per frame.
    """
    made = np.zeros_like(pose[indices])
    for row, frame in enumerate(indices.tolist()):
        first, last = max(0, frame - 1), min(len(pose), frame + 2)
        near = nearest_turn(pose[first:last], pose[frame])
        made[row] = velocities(near, valid[first:last], np.array([frame - first]))[0]
    return made


def motion_px(
    start: torch.Tensor, end: torch.Tensor, viewmats: torch.Tensor, Ks: torch.Tensor
) -> torch.Tensor:
    """How far points move in the image: the distance that a twentieth of them exceeds.

    Args:
        start: (B, N, 3) m, world, when the shutter opens.
        end: (B, N, 3) m, when it closes.
        viewmats: (B, 4, 4) world to camera.
        Ks: (B, 3, 3) px.

    Returns:
        (B,) px; 0 for points behind the camera.
    """
    places = []
    for points in (start, end):
        seen = points @ viewmats[:, :3, :3].mT + viewmats[:, None, :3, 3]
        on_image = seen @ Ks.mT
        places.append(on_image[..., :2] / on_image[..., 2:].clamp(min=1e-6))
        places[-1] = torch.where(seen[..., 2:] > 0.0, places[-1], 0.0)
    return (places[1] - places[0]).norm(dim=-1).quantile(0.95, dim=1)
