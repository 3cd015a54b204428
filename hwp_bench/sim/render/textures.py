"""Textures and relief at points of a surface, in compiled loops; texels are float32 and stay so."""

from __future__ import annotations

import numpy as np

from hwp_bench.base.kernels import compiled, helper
from hwp_bench.sim.render.hit_points import to_unit

# Largest slope of a bump.
_STEEPEST = 1.2
_ONE = np.float32(1.0)


@compiled(nogil=True)
def read_texture(mine: np.ndarray, uv: np.ndarray, texture: np.ndarray, out: np.ndarray) -> None:
    """Read a texture that repeats, between its four nearest texels.

    Args:
        mine: (M,) rows of `uv` and `out`.
        uv: (H, 2) texture coordinates.
        texture: (rows, columns, C) float32.
        out: (H, C) float32, is written.
    """
    for i in mine:
        x0, x1, y0, y1, fx, fy = _taps(uv[i], texture.shape[0], texture.shape[1])
        for k in range(texture.shape[2]):
            above = texture[y0, x0, k] * (_ONE - fx) + texture[y0, x1, k] * fx
            below = texture[y1, x0, k] * (_ONE - fx) + texture[y1, x1, k] * fx
            out[i, k] = above * (_ONE - fy) + below * fy


@compiled(nogil=True)
def bump(
    mine: np.ndarray,
    hit_faces: np.ndarray,
    uv: np.ndarray,
    height: np.ndarray,
    mesh: tuple[np.ndarray, np.ndarray, np.ndarray],
    normals: np.ndarray,
) -> None:
    """Tilt normals by a height map's slope on the posed surface.

    Args:
        mine: (M,) rows of `hit_faces`, `uv` and `normals`.
        hit_faces: (H,) face of each point.
        uv: (H, 2) texture coordinates.
        height: (rows, columns) float32 m.
        mesh: vertices (V, 3), faces (F, 3), texture coordinates (F, 3, 2).
        normals: (H, 3) unit, are changed.

    Source: Blinn, "Simulation of wrinkled surfaces", with the surface gradient
    grad h = h_u grad u + h_v grad v on each triangle.
    """
    vertices, faces, corner_uv = mesh
    rows, columns = np.float32(height.shape[0]), np.float32(height.shape[1])
    slope = np.empty(3)
    for i in mine:
        face = hit_faces[i]
        x0, x1, y0, y1, fx, fy = _taps(uv[i], height.shape[0], height.shape[1])
        p, q, r, s = height[y0, x0], height[y0, x1], height[y1, x0], height[y1, x1]
        along_u = ((q - p) * (_ONE - fy) + (s - r) * fy) * columns
        along_v = -((r - p) * (_ONE - fx) + (s - q) * fx) * rows
        a, b, c = vertices[faces[face, 0]], vertices[faces[face, 1]], vertices[faces[face, 2]]
        ex, ey, ez = b[0] - a[0], b[1] - a[1], b[2] - a[2]
        fx_, fy_, fz_ = c[0] - a[0], c[1] - a[1], c[2] - a[2]
        nx, ny, nz = ey * fz_ - ez * fy_, ez * fx_ - ex * fz_, ex * fy_ - ey * fx_
        square = max(nx * nx + ny * ny + nz * nz, 1e-18)
        dual1 = ((fy_ * nz - fz_ * ny), (fz_ * nx - fx_ * nz), (fx_ * ny - fy_ * nx))
        dual2 = ((ny * ez - nz * ey), (nz * ex - nx * ez), (nx * ey - ny * ex))
        place = corner_uv[face]
        du1, du2 = place[1, 0] - place[0, 0], place[2, 0] - place[0, 0]
        dv1, dv2 = place[1, 1] - place[0, 1], place[2, 1] - place[0, 1]
        for k in range(3):
            first, second = dual1[k] / square, dual2[k] / square
            slope[k] = along_u * (du1 * first + du2 * second) + along_v * (
                dv1 * first + dv2 * second
            )
        length = np.sqrt(slope[0] * slope[0] + slope[1] * slope[1] + slope[2] * slope[2])
        gentle = min(length, _STEEPEST) / max(length, 1e-9)
        for k in range(3):
            normals[i, k] -= slope[k] * gentle
        to_unit(normals[i])


@helper
def _taps(
    uv: np.ndarray, rows: int, columns: int
) -> tuple[int, int, int, int, np.float32, np.float32]:
    """Columns and rows of the four texels around a place (2,), and how far it is between them."""
    x = uv[0] * columns - 0.5
    y = (1.0 - uv[1]) * rows - 0.5
    left, top = np.floor(x), np.floor(y)
    x0, y0 = int(left), int(top)
    # Nearly every place lies inside, and a remainder takes as long as a texel.
    if x0 < 0 or x0 >= columns:
        x0 %= columns
    if y0 < 0 or y0 >= rows:
        y0 %= rows
    x1, y1 = x0 + 1, y0 + 1
    if x1 == columns:
        x1 = 0
    if y1 == rows:
        y1 = 0
    return x0, x1, y0, y1, np.float32(x - left), np.float32(y - top)
