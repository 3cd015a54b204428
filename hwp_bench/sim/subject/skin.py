"""Skin: colour, relief and gloss of a subject's hand, painted into the template's UV atlas.

Everything is a function of the place on the rest hand, so that the atlas shows no seams, and
the hand model knows none of it: a method has to find it out.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from hwp_bench.base.colors import srgb_to_linear
from hwp_bench.sim.geometry.noise import fractal_noise, generator
from hwp_bench.sim.scene.schema import Subject
from hwp_bench.sim.subject.anatomy import Anatomy

# sRGB of skin from light to dark, back of the hand and palm. The ends lie near the steps 3
# and 9 of the Monk Skin Tone scale, in lightness.
_TONES = (-0.4, 0.0, 0.35, 0.65, 1.0, 1.4)
_BACK = (
    np.array(
        [
            *([244, 214, 196], [234, 192, 168], [212, 160, 128]),
            *([158, 106, 76], [92, 60, 45], [60, 42, 34]),
        ]
    )
    / 255.0
)
_PALM = (
    np.array(
        [
            *([246, 205, 190], [240, 190, 172], [226, 172, 148]),
            *([204, 152, 124], [170, 120, 98], [138, 96, 80]),
        ]
    )
    / 255.0
)
# Share of the palm's colour on the inner side of a bare forearm.
_INNER_ARM = 0.3


@dataclass(frozen=True)
class SkinSample:
    """Skin at N places."""

    #: (N, 3) linear reflectance, 0-1.
    albedo: np.ndarray
    #: (N,) m outwards of the smooth surface.
    height: np.ndarray
    #: (N,) 0 (mirror) to 1 (matt).
    roughness: np.ndarray


def sample_skin(anatomy: Anatomy, subject: Subject) -> SkinSample:
    """Paint skin at the places of an anatomy.

    Args:
        anatomy: where the places are on the hand.
        subject: seed, tone and age.
    """
    rng = generator(subject.seed, "skin")
    old = np.clip((subject.age - 20.0) / 60.0, 0.0, 1.0)
    points = anatomy.points
    coarse, middle, fine, pores = (
        fractal_noise(points, scale, rng) for scale in (0.045, 0.016, 0.005, 0.0016)
    )
    back, palm = anatomy.back, 1.0 - anatomy.back
    joint_lines, joint_swell = anatomy.joint_creases(generator(subject.seed, "creases"))
    palm_lines = anatomy.palm_creases(generator(subject.seed, "palm"))
    tendons = anatomy.tendons() * back
    veins = anatomy.veins(generator(subject.seed, "veins")) * back
    nail, lunula, edge, groove = anatomy.nails()
    if subject.looks.arm == "bare":
        veins = veins * np.clip(7.0 * anatomy.palm_coordinates()[0] + 0.8, 0.0, 1.0)

    height = (
        (0.00035 + 0.0002 * old) * tendons
        + (0.00020 + 0.00030 * old) * veins
        + 0.0006 * joint_swell * back
        - (0.00022 + 0.00012 * old) * joint_lines
        - 0.00045 * palm_lines * palm
        + 0.00035 * coarse
        + 0.00012 * middle
        + (0.00004 + 0.00003 * old) * fine * (1 - nail)
        + 0.000015 * pores * (1 - nail)
        + 0.00012 * nail
        - 0.00035 * groove
    )
    tone = skin_color(subject.tone)
    pale = np.array([np.interp(subject.tone, _TONES, _PALM[:, c]) for c in range(3)])
    albedo = srgb_to_linear(tone * back[:, None] + pale * palm[:, None])
    if subject.looks.arm == "bare":
        inner = palm * _palm_fades(anatomy)
        albedo = srgb_to_linear(tone + inner[:, None] * (pale - tone))
    blood = 0.10 * coarse + 0.10 * middle + 0.55 * anatomy.flushed() + 0.35 * joint_swell * back
    albedo = albedo * np.exp(blood[:, None] * np.array([0.10, -0.30, -0.26]))
    melanin = 0.5 * middle + 0.5 * fine + (0.3 + old) * _spots(points, rng) * back
    albedo = albedo * np.exp(-(0.05 + 0.05 * old) * melanin[:, None] * np.array([0.7, 1.0, 1.25]))
    albedo = albedo * np.exp(
        -veins[:, None] * np.array([0.22, 0.10, 0.04]) * max(1.1 - subject.tone, 0.02)
    )
    dark = 0.45 * joint_lines + 0.55 * palm_lines * palm + 0.5 * groove + 0.03 * np.abs(pores)
    albedo = albedo * np.exp(-dark[:, None] * np.array([0.55, 0.9, 1.0]))
    plate = srgb_to_linear(0.55 * pale + 0.45 * np.array([0.93, 0.74, 0.70]))
    white = srgb_to_linear(np.array([0.93, 0.87, 0.82]))
    albedo = _mix(albedo, plate, nail)
    albedo = _mix(albedo, white, 0.45 * lunula + 0.75 * edge)
    roughness = 0.52 + 0.05 * fine + 0.1 * palm - 0.26 * nail
    return SkinSample(
        albedo=np.clip(albedo, 0.01, 0.95),
        height=height,
        roughness=np.clip(roughness, 0.2, 0.9),
    )


def skin_color(tone: float) -> np.ndarray:
    """Colour of skin of a tone, as on the back of the hand: (3,) sRGB."""
    return np.array([np.interp(tone, _TONES, _BACK[:, c]) for c in range(3)])


def _palm_fades(anatomy: Anatomy) -> np.ndarray:
    """Share of the palm's colour where the palm runs out into the forearm: (N,)."""
    along, _ = anatomy.palm_coordinates()
    x = np.clip((along + 0.12) / 0.34, 0.0, 1.0)
    return _INNER_ARM + (1.0 - _INNER_ARM) * x * x * (3.0 - 2.0 * x)


def _spots(points: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Freckles: the peaks of a noise, 0-1."""
    return np.clip(fractal_noise(points, 0.004, rng, octaves=1) - 1.7, 0.0, 1.0) * 3.0


def _mix(color: np.ndarray, other: np.ndarray, weight: np.ndarray) -> np.ndarray:
    return color + np.clip(weight, 0.0, 1.0)[:, None] * (other - color)
