"""Light of lamps and windows besides the key light, and of coloured walls.

A lamp's rectangle is cut into points; each throws a shadow of its own, so that a small lamp makes
hard shadows and a window soft ones. Walls replace the sky: the same openness darkens them.
"""

from __future__ import annotations

import math

import numpy as np

from hwp_bench.base.kernels import compiled, dot
from hwp_bench.sim.geometry.raycast import LIFT, Tracer
from hwp_bench.sim.render.gloss import gloss_lobe, grazing
from hwp_bench.sim.render.samples import Samples
from hwp_bench.sim.render.translucency import light_through
from hwp_bench.sim.scene.area_lights import AreaLight, wall_irradiance
from hwp_bench.sim.scene.optics import Lights

#: Points along the edge of a quarter of a lamp, by the lamp's longest edge over its distance.
#: The four samples of a pixel aim at the four quarters.
GRIDS = ((0.15, 1), (0.6, 2), (math.inf, 3))
_QUARTERS = np.array([[-0.5, -0.5], [0.5, -0.5], [-0.5, 0.5], [0.5, 0.5]])
_ONE = np.float32(1.0)


def lamp_light(
    samples: Samples, lights: Lights, tracers: list[Tracer], turn: np.ndarray
) -> np.ndarray:
    """Radiance towards the camera that the lamps add: (H, 3) linear.

    Args:
        samples: the points.
        lights: the light.
        tracers: what may throw a shadow, at least one.
        turn: (H,) 0-3, the quarter of a lamp that each sample aims at.
    """
    total = np.zeros((len(samples.ray), 3))
    passed = 1.0 if lights.cast is None else lights.cast.passed(samples.points)
    for lamp in lights.lamps:
        places = _places(lamp)
        for place in places:
            aims = lamp.centre + (_QUARTERS + place) @ np.stack([lamp.across, lamp.down])
            ways = aims[turn] - samples.points
            squared = np.einsum("hk,hk->h", ways, ways)
            directions = ways / np.sqrt(squared)[:, None]
            leaving = np.clip(-(directions @ lamp.facing), 0.0, 1.0)
            arrives = leaving * lamp.distance**2 / squared / len(places)
            arrives = arrives * passed * _reached(samples, directions, tracers)
            total += _from_point(
                (samples.normals, samples.view),
                (samples.albedo, samples.wrap, samples.roughness, samples.specular),
                directions,
                arrives,
                lamp.irradiance,
            )
        if lamp.through:
            total += light_through(samples, lamp, tracers)
    return total * lights.exposure


def room_light(samples: Samples, lights: Lights) -> np.ndarray:
    """Radiance towards the camera that the walls add: (H, 3) linear.

    Source: irradiance from six directions, weighted by the squared components of the normal
    ("ambient cube", McTaggart, "Half-Life 2 / Valve Source shading", 2004).
    """
    assert lights.room is not None
    return np.asarray(
        _from_walls(
            (samples.normals, samples.view),
            (samples.albedo, samples.roughness, samples.specular),
            samples.openness,
            (lights.room, wall_irradiance(lights.room)),
        )
        * lights.exposure
    )


def _places(lamp: AreaLight) -> np.ndarray:
    """Middles of equal parts of a quarter of the lamp, in its half edges: (n, 2)."""
    edge = next(edge for limit, edge in GRIDS if lamp.slope <= limit)
    ticks = (np.arange(edge) + 0.5) / edge - 0.5
    return np.stack(np.meshgrid(ticks, ticks), axis=-1).reshape(-1, 2)


def _reached(samples: Samples, directions: np.ndarray, tracers: list[Tracer]) -> np.ndarray:
    """Whether light from the directions reaches the samples: (H,) 0 or 1.

    A point that faces away from it is 1, as for the key light: its normal darkens it.
    """
    reached = np.ones(len(samples.ray))
    open_ = np.flatnonzero(np.einsum("hk,hk->h", samples.flat, directions) > 0.0)
    for tracer in tracers:
        origins = samples.points[open_] + LIFT * samples.flat[open_]
        dark = tracer.blocked(origins, directions[open_], "lamps")
        reached[open_[dark]] = 0.0
        open_ = open_[~dark]
    return reached


@compiled(nogil=True)
def _from_point(
    vectors: tuple[np.ndarray, np.ndarray],
    maps: tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray],
    directions: np.ndarray,
    arrives: np.ndarray,
    light: np.ndarray,
) -> np.ndarray:
    """Wrapped diffuse light and gloss of one point of a lamp: (H, 3)."""
    normals, views = vectors
    albedo, wrap, roughness, specular = maps
    out = np.empty((len(normals), 3))
    for i in range(len(normals)):
        normal, direction, beam = normals[i], directions[i], arrives[i]
        cosine = dot(normal, direction)
        gloss, _ = gloss_lobe(normal, views[i], direction, cosine, roughness[i], specular[i])
        gloss = gloss * beam * math.pi
        for k in range(3):
            wide = _ONE + wrap[i, k]
            diffuse = max((cosine + wrap[i, k]) / (wide * wide), 0.0) * beam
            out[i, k] = (albedo[i, k] * diffuse + gloss) * light[k]
    return out


@compiled(nogil=True)
def _from_walls(
    vectors: tuple[np.ndarray, np.ndarray],
    maps: tuple[np.ndarray, np.ndarray, np.ndarray],
    openness: np.ndarray,
    walls: tuple[np.ndarray, np.ndarray],
) -> np.ndarray:
    """Diffuse light of the walls with bounces, and their gloss at grazing view: (H, 3)."""
    normals, views = vectors
    albedo, roughness, specular = maps
    radiance, irradiance = walls
    out = np.empty((len(normals), 3))
    mirrored = np.empty(3)
    for i in range(len(normals)):
        normal, view, open_ = normals[i], views[i], openness[i]
        edge = grazing(normal, view, roughness[i], specular[i]) * open_
        twice = 2.0 * dot(normal, view)
        for axis in range(3):
            mirrored[axis] = twice * normal[axis] - view[axis]
        for k in range(3):
            around, seen = 0.0, 0.0
            for axis in range(3):
                side = 2 * axis if normal[axis] > 0.0 else 2 * axis + 1
                around += normal[axis] * normal[axis] * irradiance[side, k]
                side = 2 * axis if mirrored[axis] > 0.0 else 2 * axis + 1
                seen += mirrored[axis] * mirrored[axis] * radiance[side, k]
            color = albedo[i, k]
            bounced = open_ / (1.0 - color * (1.0 - open_) * 0.8)
            out[i, k] = color * around * bounced + edge * seen
    return out
