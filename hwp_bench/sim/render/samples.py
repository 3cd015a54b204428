"""Points where rays met a surface: their normals, textures and relief."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from hwp_bench.sim.geometry.mesh import unit
from hwp_bench.sim.geometry.raycast import Hits
from hwp_bench.sim.geometry.surface import Material, Surface


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

    Args:
        surface: what was hit.
        hits: where.
        directions: (N, 3) of the rays that were cast.
    """
    corners = surface.faces[hits.face]
    weights = hits.weights
    a, b, c = (surface.vertices[corners[:, k]] for k in range(3))
    points = weights[:, :1] * a + weights[:, 1:2] * b + weights[:, 2:] * c
    view = -unit(directions[hits.ray])
    flat = unit(np.cross(b - a, c - a))
    normals = unit(_spread(surface.normals, corners, weights))
    behind = np.einsum("ni,ni->n", flat, view) < 0
    flat[behind] *= -1.0
    normals[behind] *= -1.0
    uv = np.einsum("nk,nkc->nc", weights, surface.corner_uv[hits.face])
    count = len(hits.ray)
    albedo = np.empty((count, 3), dtype=np.float32)
    roughness = np.empty(count, dtype=np.float32)
    specular = np.empty(count, dtype=np.float32)
    glow = np.zeros(count, dtype=np.float32)
    wrap = np.zeros((count, 3), dtype=np.float32)
    owner = surface.material[hits.face]
    for index, material in enumerate(surface.materials):
        mine = np.flatnonzero(owner == index)
        if not len(mine):
            continue
        taps = _Taps(uv[mine], material.albedo.shape[:2])
        albedo[mine] = taps.read(material.albedo)
        roughness[mine] = (
            material.gloss if material.roughness is None else taps.read(material.roughness)
        )
        specular[mine] = material.specular
        glow[mine] = material.glow
        wrap[mine] = material.wrap
        if material.height is not None:
            slopes = _slopes(material, taps)
            normals[mine] = _bumped(
                normals[mine],
                (a[mine], b[mine], c[mine]),
                surface.corner_uv[hits.face[mine]],
                slopes,
            )
    openness = np.ones(count)
    if surface.openness is not None:
        openness = _spread(surface.openness[:, None], corners, weights)[:, 0]
    return Samples(
        ray=hits.ray,
        distance=hits.distance,
        points=points,
        normals=normals,
        flat=flat,
        view=view,
        albedo=albedo,
        roughness=roughness,
        specular=specular,
        wrap=wrap,
        glow=glow,
        openness=openness,
        hand=surface.hand[hits.face].astype(bool),
    )


def _spread(values: np.ndarray, corners: np.ndarray, weights: np.ndarray) -> np.ndarray:
    return (
        weights[:, :1] * values[corners[:, 0]]
        + weights[:, 1:2] * values[corners[:, 1]]
        + weights[:, 2:] * values[corners[:, 2]]
    )


class _Taps:
    """The four texels around each place, and their weights; the texture repeats."""

    def __init__(self, uv: np.ndarray, shape: tuple[int, int]) -> None:
        height, width = shape
        x = uv[:, 0] * width - 0.5
        y = (1.0 - uv[:, 1]) * height - 0.5
        left, top = np.floor(x), np.floor(y)
        fx, fy = (x - left).astype(np.float32), (y - top).astype(np.float32)
        x0, y0 = left.astype(np.int64) % width, top.astype(np.int64) % height
        x1, y1 = (x0 + 1) % width, (y0 + 1) % height
        self.index = (y0 * width + x0, y0 * width + x1, y1 * width + x0, y1 * width + x1)
        self.fx, self.fy = fx, fy
        self.shape = shape

    def read(self, texture: np.ndarray) -> np.ndarray:
        flat = texture.reshape(-1, *texture.shape[2:])
        fx, fy = (f[:, None] if flat.ndim == 2 else f for f in (self.fx, self.fy))
        a, b, c, d = (flat[index] for index in self.index)
        return (a * (1 - fx) + b * fx) * (1 - fy) + (c * (1 - fx) + d * fx) * fy


def _slopes(material: Material, taps: _Taps) -> tuple[np.ndarray, np.ndarray]:
    """Slope of the height map in u and v, per unit of texture coordinate."""
    assert material.height is not None
    flat = material.height.reshape(-1)
    a, b, c, d = (flat[index] for index in taps.index)
    rows, columns = taps.shape
    along_u = ((b - a) * (1 - taps.fy) + (d - c) * taps.fy) * columns
    along_v = -((c - a) * (1 - taps.fx) + (d - b) * taps.fx) * rows
    return along_u, along_v


def _bumped(
    normals: np.ndarray,
    corners: tuple[np.ndarray, np.ndarray, np.ndarray],
    uv: np.ndarray,
    slopes: tuple[np.ndarray, np.ndarray],
) -> np.ndarray:
    """Tilt normals by a height map's slope on the posed surface.

    Source: Blinn, "Simulation of wrinkled surfaces", with the surface gradient
    grad h = h_u grad u + h_v grad v on each triangle.
    """
    a, b, c = corners
    e1, e2 = b - a, c - a
    d1, d2 = uv[:, 1] - uv[:, 0], uv[:, 2] - uv[:, 0]
    normal = np.cross(e1, e2)
    square = np.maximum(np.einsum("ni,ni->n", normal, normal), 1e-18)[:, None]
    dual1, dual2 = np.cross(e2, normal) / square, np.cross(normal, e1) / square
    grad_u = d1[:, :1] * dual1 + d2[:, :1] * dual2
    grad_v = d1[:, 1:] * dual1 + d2[:, 1:] * dual2
    slope = slopes[0][:, None] * grad_u + slopes[1][:, None] * grad_v
    length = np.linalg.norm(slope, axis=1, keepdims=True)
    slope = slope * (np.minimum(length, 1.2) / np.maximum(length, 1e-9))
    return unit(normals - slope)
