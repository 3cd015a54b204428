"""The compiled loop of `shading`: light that leaves points towards the camera."""

from __future__ import annotations

import math

import numpy as np

from hwp_bench.base.kernels import compiled, dot
from hwp_bench.sim.render.gloss import gloss_lobe

_ONE = np.float32(1.0)


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
        exposure: factor on everything.
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
