"""Shading in linear light: where rays met a surface, what reaches it, and what the camera gets.

A lamp's rectangle is cut into points; each throws a shadow of its own, so that a small lamp makes
hard shadows and a window soft ones. Walls replace the sky: the same openness darkens them.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np

from hwp_bench.base.kernels import compiled, dot, helper
from hwp_bench.sim.geometry.surface import LIFT, Hits, Surface, Tracer
from hwp_bench.sim.light.lights import AreaLight, Lights, wall_irradiance


@compiled(nogil=True)
def at_hits(
    mesh: tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray],
    hits: tuple[np.ndarray, np.ndarray, np.ndarray],
    directions: np.ndarray,
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Geometry at the hits.

    Takes `mesh` vertices (V, 3), normals (V, 3), faces (F, 3), texture coordinates (F, 3, 2);
    `hits` ray (H,), face (H,) and weights (H, 3). Returns points (H, 3); unit vectors (H, 3) to
    the camera, of the face and of the smooth surface, both turned to the camera; and (H, 2).
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
    """Read a texture (rows, columns, C) that repeats, between its four nearest texels."""
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
    """Tilt the `normals` in the rows `mine` by a height map's slope on the posed surface.

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
    """Collect what shading needs at the hits."""
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


_LEAST_ROUGH, _MOST_GLOSS = np.float32(0.05), np.float32(0.8)


@helper
def gloss_lobe(
    normal: np.ndarray,
    view: np.ndarray,
    direction: np.ndarray,
    cosine: float,
    roughness: np.float32,
    specular: np.float32,
) -> float:
    """Gloss of a lamp, before what arrives.

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
    return lobe * shape * fresnel * nl


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
    """Radiance towards the camera: (H, 3) linear; `shade` names model and sources.

    Takes `vectors` normals and unit vectors to the camera, (H, 3) each; `maps` albedo (H, 3), wrap
    (H, 3), roughness, specular and glow (H,), all float32; `arrives` shares of the key light and of
    the sky, (H,) float64; `lights` (4, 3) direction of the key light, its irradiance, radiance from
    above and below.
    """
    normals, views = vectors
    albedo, wrap, roughness, specular, glow = maps
    lit, openness = arrives
    direction, key, sky, ground = lights[0], lights[1], lights[2], lights[3]
    out = np.empty((len(normals), 3))
    for i in range(len(normals)):
        normal, view, open_, beam = normals[i], views[i], openness[i], lit[i]
        cosine = dot(normal, direction)
        gloss = gloss_lobe(normal, view, direction, cosine, roughness[i], specular[i])
        gloss = gloss * beam * math.pi
        edge = grazing(normal, view, roughness[i], specular[i]) * open_
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
    """Radiance towards the camera, of the share of the key light that arrives: (H, 3) linear.

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
    """Share of the half space above each point, by the cosine, that nothing near blocks: (V,)."""
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
    """Whether the key light reaches each sample: (H,) 0 or 1.

    A point that faces away from the lamp is 1: its normal darkens it.
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
    """Radiance towards the camera that the lamps add: (H, 3) linear."""
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
            total += np.reshape(passed, (-1, 1)) * light_through(samples, lamp, tracers)
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
        gloss = gloss_lobe(normal, views[i], direction, cosine, roughness[i], specular[i])
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
