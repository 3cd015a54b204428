"""Shading in linear light: which light reaches a point, wrapped diffuse light and gloss."""

from __future__ import annotations

import numpy as np

from hwp_bench.sim.geometry.raycast import LIFT, Tracer
from hwp_bench.sim.render.radiance import radiance
from hwp_bench.sim.render.samples import Samples
from hwp_bench.sim.scene.optics import Lights

#: Rays per vertex that look for the sky.
SKY_RAYS = 24
#: How far the sky's rays reach, m: beyond it nothing darkens.
SKY_REACH = 0.08
# Radius of the key light's disc as a slope; makes the rim of shadows soft.
_LIGHT_RADIUS = 0.06
# Points of the disc that the four rays of a pixel aim at.
_DISC = np.array([[-0.4, -0.8], [0.8, -0.4], [-0.8, 0.4], [0.4, 0.8]])


def shade(samples: Samples, lights: Lights, lit: np.ndarray) -> np.ndarray:
    """Radiance towards the camera: (H, 3) linear.

    Args:
        samples: the points.
        lights: the light.
        lit: (H,) share of the key light that arrives, 0-1.

    Source: Lambert with wrapped terminator for skin, hemisphere sky, and the GGX lobe with
    Schlick's Fresnel term and Smith-Schlick visibility for the gloss.
    """
    if lights.cast is not None:
        lit = lit * lights.cast.passed(samples.points)
    return radiance(
        (samples.normals, samples.view),
        (samples.albedo, samples.wrap, samples.roughness, samples.specular, samples.glow),
        (lit, samples.openness),
        np.stack([lights.direction, lights.key, lights.sky, lights.ground]),
        lights.exposure,
    )


def openness(tracer: Tracer, vertices: np.ndarray, normals: np.ndarray) -> np.ndarray:
    """Share of the half space above each point, weighted by the cosine, that nothing near blocks.

    Args:
        tracer: what may block.
        vertices: (V, 3) m.
        normals: (V, 3) unit.

    Returns:
        (V,) 0-1.
    """
    index = np.arange(SKY_RAYS) + 0.5
    height = np.sqrt(1.0 - index / SKY_RAYS)
    spin = np.pi * (3.0 - np.sqrt(5.0)) * index
    flat = np.sqrt(1.0 - height**2)
    local = np.stack([flat * np.cos(spin), flat * np.sin(spin), height], axis=1)
    helper = np.where(np.abs(normals[:, :1]) < 0.8, [[1.0, 0.0, 0.0]], [[0.0, 1.0, 0.0]])
    tangent = np.cross(helper, normals)
    tangent /= np.linalg.norm(tangent, axis=1, keepdims=True)
    frames = np.stack([tangent, np.cross(normals, tangent), normals], axis=1)
    directions = np.einsum("rk,vkc->vrc", local, frames).reshape(-1, 3)
    origins = np.repeat(vertices + 2.0 * LIFT * normals, SKY_RAYS, axis=0)
    hits = tracer.first_hits(origins, directions, "sky")
    blocked = np.zeros(len(directions))
    blocked[hits.ray] = np.sqrt(np.clip(1.0 - hits.distance / SKY_REACH, 0.0, 1.0))
    return 1.0 - blocked.reshape(-1, SKY_RAYS).mean(axis=1)


def lit(samples: Samples, lights: Lights, tracers: list[Tracer], turn: np.ndarray) -> np.ndarray:
    """Whether the key light reaches each sample.

    Args:
        samples: the points.
        lights: the light.
        tracers: what may throw a shadow, at least one.
        turn: (H,) 0-3, which part of the lamp each sample aims at; the samples of a pixel aim
            at different parts, which softens the shadow's rim.

    Returns:
        (H,) 0 or 1. A point that faces away from the lamp is 1: its normal darkens it.
    """
    reached = np.ones(len(samples.ray))
    if not lights.key.any():
        return reached
    facing = np.flatnonzero(samples.flat @ lights.direction > 0.0)
    helper = np.array([0.0, 0.0, 1.0])
    if abs(lights.direction[2]) > 0.9:
        helper = np.array([1.0, 0.0, 0.0])
    first = np.cross(lights.direction, helper)
    first /= np.linalg.norm(first)
    second = np.cross(lights.direction, first)
    aim = lights.direction + _LIGHT_RADIUS * (_DISC @ np.stack([first, second]))
    directions = aim[turn[facing]]
    origins = samples.points[facing] + LIFT * samples.flat[facing]
    dark = tracers[0].blocked(origins, directions, "shadow")
    for tracer in tracers[1:]:
        open_ = np.flatnonzero(~dark)
        dark[open_] = tracer.blocked(origins[open_], directions[open_], "shadow")
    reached[facing[dark]] = 0.0
    return reached
