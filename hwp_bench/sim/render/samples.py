"""Points where rays met a surface: their normals, textures and relief."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from hwp_bench.sim.geometry.raycast import Hits
from hwp_bench.sim.geometry.surface import Surface
from hwp_bench.sim.render.hit_points import at_hits, spread
from hwp_bench.sim.render.textures import bump, read_texture


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
