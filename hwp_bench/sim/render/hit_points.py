"""The points where rays met a mesh, in one compiled pass: NumPy would write each step to memory."""

from __future__ import annotations

import numpy as np

from hwp_bench.base.kernels import compiled, helper


@compiled(nogil=True)
def at_hits(
    mesh: tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray],
    hits: tuple[np.ndarray, np.ndarray, np.ndarray],
    directions: np.ndarray,
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Geometry at the hits.

    Args:
        mesh: vertices (V, 3), normals (V, 3), faces (F, 3), texture coordinates (F, 3, 2).
        hits: ray (H,), face (H,) and weights (H, 3) of each.
        directions: (N, 3) of the rays.

    Returns:
        points (H, 3) m; unit vectors (H, 3) to the camera, of the face and of the smooth surface,
        both turned to the camera; texture coordinates (H, 2).
    """
    vertices, vertex_normals, faces, corner_uv = mesh
    rays, hit_faces, weights = hits
    count = len(rays)
    points, view = np.empty((count, 3)), np.empty((count, 3))
    flat, normals, uv = np.empty((count, 3)), np.empty((count, 3)), np.empty((count, 2))
    for i in range(count):
        face = hit_faces[i]
        ia, ib, ic = faces[face, 0], faces[face, 1], faces[face, 2]
        u, v, w = weights[i, 0], weights[i, 1], weights[i, 2]
        for k in range(3):
            points[i, k] = u * vertices[ia, k] + v * vertices[ib, k] + w * vertices[ic, k]
            normals[i, k] = (
                u * vertex_normals[ia, k] + v * vertex_normals[ib, k] + w * vertex_normals[ic, k]
            )
            view[i, k] = -directions[rays[i], k]
        for k in range(2):
            uv[i, k] = (
                u * corner_uv[face, 0, k] + v * corner_uv[face, 1, k] + w * corner_uv[face, 2, k]
            )
        a, b, c = vertices[ia], vertices[ib], vertices[ic]
        ex, ey, ez = b[0] - a[0], b[1] - a[1], b[2] - a[2]
        fx, fy, fz = c[0] - a[0], c[1] - a[1], c[2] - a[2]
        flat[i, 0], flat[i, 1], flat[i, 2] = ey * fz - ez * fy, ez * fx - ex * fz, ex * fy - ey * fx
        to_unit(view[i])
        to_unit(flat[i])
        to_unit(normals[i])
        if flat[i, 0] * view[i, 0] + flat[i, 1] * view[i, 1] + flat[i, 2] * view[i, 2] < 0.0:
            for k in range(3):
                flat[i, k] = -flat[i, k]
                normals[i, k] = -normals[i, k]
    return points, view, flat, normals, uv


@compiled(nogil=True)
def spread(
    values: np.ndarray, faces: np.ndarray, hit_faces: np.ndarray, weights: np.ndarray
) -> np.ndarray:
    """Values (V,) of the vertices at the hits: (H,)."""
    out = np.empty(len(hit_faces))
    for i in range(len(hit_faces)):
        corners = faces[hit_faces[i]]
        out[i] = (
            weights[i, 0] * values[corners[0]]
            + weights[i, 1] * values[corners[1]]
            + weights[i, 2] * values[corners[2]]
        )
    return out


@helper
def to_unit(vector: np.ndarray) -> None:
    """Bring a vector (3,) to length 1; zero stays zero."""
    length = np.sqrt(vector[0] * vector[0] + vector[1] * vector[1] + vector[2] * vector[2])
    length = max(length, 1e-12)
    for k in range(3):
        vector[k] = vector[k] / length
