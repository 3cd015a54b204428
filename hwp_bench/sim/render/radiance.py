"""The compiled loop of `shading`: light that leaves points towards the camera."""

from __future__ import annotations

import math

import numpy as np

from hwp_bench.base.compiled import compiled, helper

_ONE, _LEAST_ROUGH, _MOST_GLOSS = np.float32(1.0), np.float32(0.05), np.float32(0.8)


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
        cosine = _dot(normal, direction)
        gloss, edge = _gloss(normal, view, direction, cosine, roughness[i], specular[i])
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


@helper
def _gloss(
    normal: np.ndarray,
    view: np.ndarray,
    direction: np.ndarray,
    cosine: float,
    roughness: np.float32,
    specular: np.float32,
) -> tuple[float, float]:
    """Gloss of the key light, and of the sky at grazing view, both before what arrives."""
    hx, hy, hz = view[0] + direction[0], view[1] + direction[1], view[2] + direction[2]
    length = max(np.sqrt(hx * hx + hy * hy + hz * hz), 1e-12)
    hx, hy, hz = hx / length, hy / length, hz / length
    nh = min(max(normal[0] * hx + normal[1] * hy + normal[2] * hz, 0.0), 1.0)
    nv = min(max(_dot(normal, view), 0.05), 1.0)
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
def _fifth(x: float) -> float:
    square = x * x
    return square * square * x


@helper
def _dot(a: np.ndarray, b: np.ndarray) -> float:
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]
