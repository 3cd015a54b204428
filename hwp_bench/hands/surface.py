"""Normals of a posed mesh, and the way to trimesh."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
import torch

if TYPE_CHECKING:
    import trimesh

# Squared length, m^4 for face normals and m^2 for edges, under which a direction is noise.
_TINY = 1e-30


def unit_or(vectors: torch.Tensor, fallback: torch.Tensor) -> torch.Tensor:
    """Vectors of length one; where there is no direction, the fallback with zero gradient.

    Args:
        vectors: (..., 3).
        fallback: broadcastable to `vectors`.
    """
    squared = (vectors * vectors).sum(dim=-1, keepdim=True)
    usable = squared > _TINY
    length = torch.where(usable, squared, torch.ones_like(squared)).sqrt()
    return torch.where(usable, vectors / length, fallback)


def vertex_normals(vertices: torch.Tensor, faces: torch.Tensor) -> torch.Tensor:
    """Outward unit normals at the vertices: face normals averaged by area.

    Args:
        vertices: (B, V, 3) or (V, 3) m.
        faces: (F, 3) int64, counter-clockwise from outside.

    Returns:
        Normals of the vertices' shape. A vertex without a face of any area gets (0, 0, 1) and
        no gradient.
    """
    corners = vertices[..., faces, :]
    edges = corners[..., 1:, :] - corners[..., :1, :]
    crosses = torch.linalg.cross(edges[..., 0, :], edges[..., 1, :])
    sums = torch.zeros_like(vertices)
    for corner in faces.unbind(dim=1):
        sums = sums.index_add(-2, corner, crosses)
    return unit_or(sums, vertices.new_tensor([0.0, 0.0, 1.0]))


def to_trimesh(vertices: torch.Tensor | np.ndarray, faces: Any) -> trimesh.Trimesh:
    """One mesh for trimesh, vertices kept as they are (no merging).

    Args:
        vertices: (V, 3) m.
        faces: (F, 3).
    """
    import trimesh

    if isinstance(vertices, torch.Tensor):
        vertices = vertices.detach().cpu().numpy()
    return trimesh.Trimesh(np.asarray(vertices), np.asarray(faces), process=False)
