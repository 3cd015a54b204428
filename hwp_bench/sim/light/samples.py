"""Points where rays met a surface: their normals, textures and relief, in compiled loops."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from hwp_bench.base.kernels import compiled, helper
from hwp_bench.sim.geometry.rays import Hits
from hwp_bench.sim.geometry.surface import Surface


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


@dataclass(frozen=True, eq=False)
class Samples:
    """Points where rays met a surface, with everything that shading needs."""

    #: (H,) ray of each point.
    ray: np.ndarray
    #: (H,) depth along the ray, in lengths of its direction.
    distance: np.ndarray
    #: (H, 3) m.
    points: np.ndarray
    #: (H, 3) unit shading normals.
    normals: np.ndarray
    #: (H, 3) unit geometric normals, towards the camera.
    flat: np.ndarray
    #: (H, 3) unit vectors to the camera.
    view: np.ndarray
    #: (H, 3) linear reflectance.
    albedo: np.ndarray
    #: (H,) 0-1.
    roughness: np.ndarray
    #: (H,) reflectance at normal incidence.
    specular: np.ndarray
    #: (H, 3) wrap of the diffuse light.
    wrap: np.ndarray
    #: (H,) share of the albedo that the surface emits itself.
    glow: np.ndarray
    #: (H,) share of the sky that is seen.
    openness: np.ndarray
    #: (H,) bool, hand or not.
    hand: np.ndarray


def gather(surface: Surface, hits: Hits, directions: np.ndarray) -> Samples:
    """Collect what shading needs at the hits.

    Takes `directions` (N, 3) of the rays that were cast.
    """
    faces = np.ascontiguousarray(surface.faces, np.int64)
    vertices = np.ascontiguousarray(surface.vertices)
    corner_uv = np.ascontiguousarray(surface.corner_uv)
    points, view, flat, normals, uv = at_hits(
        (vertices, np.ascontiguousarray(surface.normals), faces, corner_uv),
        (hits.ray, hits.face, hits.weights),
        directions,
    )
    count = len(hits.ray)
    albedo = np.empty((count, 3), dtype=np.float32)
    roughness = np.empty(count, dtype=np.float32)
    owner = surface.material[hits.face]
    for index, material in enumerate(surface.materials):
        mine = np.flatnonzero(owner == index)
        if not len(mine):
            continue
        read_texture(mine, uv, material.albedo, albedo)
        if material.roughness is None:
            roughness[mine] = material.gloss
        else:
            read_texture(mine, uv, material.roughness[..., None], roughness[:, None])
        if material.height is not None:
            bump(mine, hits.face, uv, material.height, (vertices, faces, corner_uv), normals)
    openness = np.ones(count)
    if surface.openness is not None:
        openness = spread(surface.openness, faces, hits.face, hits.weights)

    def of_material(values: list[Any]) -> np.ndarray:
        return np.array(values, dtype=np.float32)[owner]

    return Samples(
        ray=hits.ray,
        distance=hits.distance,
        points=points,
        normals=normals,
        flat=flat,
        view=view,
        albedo=albedo,
        roughness=roughness,
        specular=of_material([material.specular for material in surface.materials]),
        wrap=of_material([material.wrap for material in surface.materials]),
        glow=of_material([material.glow for material in surface.materials]),
        openness=openness,
        hand=surface.hand[hits.face].astype(bool),
    )
