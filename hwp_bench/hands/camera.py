"""Pinhole projection in OpenCV axes."""

from __future__ import annotations

import torch

from hwp_bench.base.errors import ShapeMismatch


def project(
    points: torch.Tensor, viewmats: torch.Tensor, Ks: torch.Tensor
) -> tuple[torch.Tensor, torch.Tensor]:
    """Project points with one pinhole camera for each frame.

    Camera axes: x right, y down, z forward. The centre of the top left pixel is (0.5, 0.5).

    Args:
        points: (B, P, 3) m, world.
        viewmats: (B, 4, 4) world to camera.
        Ks: (B, 3, 3) intrinsics, px.

    Returns:
        pixels: (B, P, 2) px; a point in the camera's own plane (zero depth) gets a finite
            place far off screen, with no gradient from the division.
        depth: (B, P) m along z; not positive behind the camera.

    Raises:
        ShapeMismatch: the arguments do not describe the same frames.
    """
    frames = points.shape[0]
    for field, value, shape in (
        ("points", points, (frames, *points.shape[1:2], 3)),
        ("viewmats", viewmats, (frames, 4, 4)),
        ("Ks", Ks, (frames, 3, 3)),
    ):
        if tuple(value.shape) != shape:
            raise ShapeMismatch(f"shape is {tuple(value.shape)}, expected {shape}", field=field)
    in_camera = points @ viewmats[:, :3, :3].mT + viewmats[:, None, :3, 3]
    depth = in_camera[..., 2]
    tiny = torch.finfo(depth.dtype).eps
    safe = torch.where(depth.abs() < tiny, torch.full_like(depth, tiny), depth)
    rays = torch.cat([in_camera[..., :2] / safe[..., None], torch.ones_like(safe[..., None])], -1)
    return (rays @ Ks.mT)[..., :2], depth
