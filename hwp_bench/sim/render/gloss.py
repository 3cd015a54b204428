"""Compiled helpers of the shading loops: the GGX lobe, gloss at grazing view."""

from __future__ import annotations

import math

import numpy as np

from hwp_bench.base.kernels import dot, helper

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
