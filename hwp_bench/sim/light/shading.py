"""Shading in linear light: what reaches a point, and what leaves it towards the camera.

A lamp's rectangle is cut into points; each throws a shadow of its own, so that a small lamp makes
hard shadows and a window soft ones. Walls replace the sky: the same openness darkens them.
"""

from __future__ import annotations

import math

import numpy as np

from hwp_bench.base.kernels import compiled, dot, helper
from hwp_bench.sim.geometry.rays import LIFT, Tracer
from hwp_bench.sim.light.lights import AreaLight, Lights, wall_irradiance
from hwp_bench.sim.light.samples import Samples

_ONE, _LEAST_ROUGH, _MOST_GLOSS = np.float32(1.0), np.float32(0.05), np.float32(0.8)


@helper
def gloss_lobe(
    normal: np.ndarray,
    view: np.ndarray,
    direction: np.ndarray,
    cosine: float,
    roughness: np.float32,
    specular: np.float32,
) -> tuple[float, float]:
    """Gloss of a lamp, and of the sky at grazing view, both before what arrives.

    Source: the GGX lobe with Schlick's Fresnel term and Smith-Schlick visibility.
    """
    hx, hy, hz = view[0] + direction[0], view[1] + direction[1], view[2] + direction[2]
    length = max(np.sqrt(hx * hx + hy * hy + hz * hz), 1e-12)
    hx, hy, hz = hx / length, hy / length, hz / length
    nh = min(max(normal[0] * hx + normal[1] * hy + normal[2] * hz, 0.0), 1.0)
    nv = min(max(dot(normal, view), 0.05), 1.0)
    nl = min(max(cosine, 0.0), 1.0)
    vh = min(max(view[0] * hx + view[1] * hy + view[2] * hz, 0.0), 1.0)
    alpha = min(max(roughness, _LEAST_ROUGH), _ONE)
    alpha = alpha * alpha
    square = alpha * alpha
    spread = nh * nh * (square - _ONE) + 1.0
    lobe = square / max(math.pi * (spread * spread), 1e-9)
    k = alpha / np.float32(2.0)
    shape = 0.25 / ((nl * (_ONE - k) + k) * (nv * (_ONE - k) + k))
    fresnel = specular + (_ONE - specular) * _fifth(1.0 - vh)
    edge = specular + (_ONE - specular) * _fifth(1.0 - nv)
    return lobe * shape * fresnel * nl, 0.5 * edge * (_ONE - _MOST_GLOSS * roughness)


@helper
def grazing(
    normal: np.ndarray, view: np.ndarray, roughness: np.float32, specular: np.float32
) -> float:
    """Gloss of the surroundings, which grows towards grazing view."""
    nv = min(max(dot(normal, view), 0.05), 1.0)
    edge = specular + (_ONE - specular) * _fifth(1.0 - nv)
    return 0.5 * edge * (_ONE - _MOST_GLOSS * roughness)


@helper
def _fifth(x: float) -> float:
    square = x * x
    return square * square * x


@compiled(nogil=True)
def radiance(
    vectors: tuple[np.ndarray, np.ndarray],
    maps: tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, np.ndarray],
    arrives: tuple[np.ndarray, np.ndarray],
    lights: np.ndarray,
    exposure: float,
) -> np.ndarray:
    """Radiance towards the camera: (H, 3) linear; `shading.shade` names model and sources.

    Args:
        vectors: unit normals (H, 3) and unit vectors to the camera (H, 3).
        maps: albedo (H, 3), wrap (H, 3), roughness, specular and glow (H,), all float32.
        arrives: shares of the key light and of the sky that reach each point, (H,) float64.
        lights: (4, 3) direction of the key light, its irradiance, radiance from above and below.
    """
    normals, views = vectors
    albedo, wrap, roughness, specular, glow = maps
    lit, openness = arrives
    direction, key, sky, ground = lights[0], lights[1], lights[2], lights[3]
    out = np.empty((len(normals), 3))
    for i in range(len(normals)):
        normal, view, open_, beam = normals[i], views[i], openness[i], lit[i]
        cosine = dot(normal, direction)
        gloss, edge = gloss_lobe(normal, view, direction, cosine, roughness[i], specular[i])
        gloss = gloss * beam * math.pi
        edge = edge * open_
        up = 0.5 - 0.5 * normal[1]
        for k in range(3):
            color, around = albedo[i, k], wrap[i, k]
            wide = _ONE + around
            # Light that wraps past the terminator has gone through the skin: shadow softens it.
            diffuse = max((cosine + around) / (wide * wide), 0.0) * beam
            # Bounces between skin and skin brighten occluded parts, in the skin's own colour.
            bounced = open_ / (1.0 - color * (1.0 - open_) * 0.8)
            hemisphere = (up * sky[k] + (1.0 - up) * ground[k]) * bounced
            value = color * (diffuse * key[k] + hemisphere)
            value += gloss * key[k] + edge * sky[k]
            value += glow[i] * color
            out[i, k] = value * exposure
    return out


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

    Takes `lit` (H,) share of the key light that arrives.

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

    Takes `vertices` (V, 3) m, `normals` (V, 3) unit. Returns (V,) 0-1.
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

    Takes `turn` (H,) 0-3. Returns (H,) 0 or 1. A point that faces away from the lamp is 1: its
    normal darkens it.
    """
    if not lights.key.any():
        return np.ones(len(samples.ray))
    facing = np.flatnonzero(samples.flat @ lights.direction > 0.0)
    helper = np.array([0.0, 0.0, 1.0])
    if abs(lights.direction[2]) > 0.9:
        helper = np.array([1.0, 0.0, 0.0])
    first = np.cross(lights.direction, helper)
    first /= np.linalg.norm(first)
    second = np.cross(lights.direction, first)
    aim = lights.direction + _LIGHT_RADIUS * (_DISC @ np.stack([first, second]))
    return _reached(samples, facing, aim[turn[facing]], tracers, "shadow")


def _reached(
    samples: Samples, rows: np.ndarray, directions: np.ndarray, tracers: list[Tracer], purpose: str
) -> np.ndarray:
    """Whether light reaches the samples: (H,) 0 or 1; 1 for all but `rows` (R,).

    `directions` (R, 3) lead from these samples to the light. One that faces away from it has no
    row: its normal darkens it.
    """
    reached = np.ones(len(samples.ray))
    origins = samples.points[rows] + LIFT * samples.flat[rows]
    for tracer in tracers:
        dark = tracer.blocked(origins, directions, purpose)
        reached[rows[dark]] = 0.0
        rows, origins, directions = rows[~dark], origins[~dark], directions[~dark]
    return reached


#: Way in which light inside skin falls by e, m, linear red, green and blue. Source: effective
#: transport 1 / sqrt(3 a (a + s)) of "skin1" in Jensen et al., "A practical model for subsurface
#: light transport", 2001, with absorption a and reduced scattering s.
SKIN_REACH = (0.00368, 0.00136, 0.00068)
#: Way beyond which nothing is left that a camera sees, m.
THICKEST = 0.02


def light_through(samples: Samples, lamp: AreaLight, tracers: list[Tracer]) -> np.ndarray:
    """Radiance towards the camera of light that came through the hand: (H, 3) linear.

    A ray from each point that faces away goes through the hand to the middle of the lamp.
    """
    found = np.zeros((len(samples.ray), 3))
    ways = lamp.centre - samples.points
    squared = np.einsum("hk,hk->h", ways, ways)
    directions = ways / np.sqrt(squared)[:, None]
    away = np.einsum("hk,hk->h", samples.flat, directions) < 0.0
    mine = np.flatnonzero(away & samples.hand)
    inside = samples.points[mine] - 2.0 * LIFT * samples.flat[mine]
    hits = tracers[0].first_hits(inside, directions[mine], "through")
    thin = hits.distance < THICKEST
    rows, thickness = mine[hits.ray[thin]], hits.distance[thin]
    exits = inside[hits.ray[thin]] + (thickness + LIFT)[:, None] * directions[rows]
    for tracer in tracers:
        free = ~tracer.blocked(exits, directions[rows], "through")
        rows, thickness, exits = rows[free], thickness[free], exits[free]
    leaving = np.clip(-(directions[rows] @ lamp.facing), 0.0, 1.0)
    arrives = leaving * lamp.distance**2 / squared[rows]
    left = np.exp(-thickness[:, None] / np.array(SKIN_REACH))
    found[rows] = samples.albedo[rows] * left * arrives[:, None] * lamp.irradiance
    return lamp.through * found


#: Points along the edge of a quarter of a lamp, by the lamp's longest edge over its distance.
#: The four samples of a pixel aim at the four quarters.
GRIDS = ((0.15, 1), (0.6, 2), (math.inf, 3))
_QUARTERS = np.array([[-0.5, -0.5], [0.5, -0.5], [-0.5, 0.5], [0.5, 0.5]])


def lamp_light(
    samples: Samples, lights: Lights, tracers: list[Tracer], turn: np.ndarray
) -> np.ndarray:
    """Radiance towards the camera that the lamps add: (H, 3) linear.

    Takes `turn` (H,) 0-3.
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
            rows = np.flatnonzero(np.einsum("hk,hk->h", samples.flat, directions) > 0.0)
            arrives = arrives * passed
            arrives = arrives * _reached(samples, rows, directions[rows], tracers, "lamps")
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
