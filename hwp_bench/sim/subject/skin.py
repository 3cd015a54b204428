"""Skin: colour, relief and gloss of a subject's hand, with everything that looks add to it.

Everything is a function of the place on the rest hand, so that its atlas shows no seams, and
the hand model knows none of it: a method has to find it out.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from hwp_bench.base.colors import srgb_to_linear
from hwp_bench.base.numerics import kd_tree
from hwp_bench.hands.poses import FIRST_JOINT
from hwp_bench.hands.skeleton import FINGERS
from hwp_bench.sim.geometry.noise import fractal_noise, generator
from hwp_bench.sim.geometry.surface import unit
from hwp_bench.sim.hand.anatomy import Anatomy
from hwp_bench.sim.subject.subject import PLAIN, Subject
from hwp_bench.sim.subject.wear import SkinSample, _polished, gloved, tattoo_cover

# Freckles lie one to a cell of a grid that fills this box around hand and forearm, m.
_CELL = 0.0031
_BOX = np.array([[-0.24, 0.34], [-0.09, 0.09], [-0.12, 0.12]])
# Hairs on a square centimetre of the back of the hand where hair is 1.
_HAIRS = 26.0
# Steps of a hair along the skin, and their length in m.
_STEPS, _STEP = 32, 0.0003


def freckles(points: np.ndarray, amount: float, rng: np.random.Generator) -> np.ndarray:
    """Round spots of 0.4 to 1.4 mm: (N,), 0 outside and up to 1 inside a spot.

    Takes `points` (N, 3) m on the rest hand.
    """
    ticks = [np.arange(low, high, _CELL) for low, high in _BOX]
    cells = np.stack(np.meshgrid(*ticks, indexing="ij"), axis=-1).reshape(-1, 3)
    centers = cells + rng.uniform(0.0, _CELL, cells.shape)
    radius = 0.0004 + 0.001 * rng.uniform(size=len(cells)) ** 3
    depth = rng.uniform(0.3, 1.0, len(cells))
    there = rng.uniform(size=len(cells)) < 0.85 * amount
    low, high = points.min(axis=0) - _CELL, points.max(axis=0) + _CELL
    there &= np.all((centers > low) & (centers < high), axis=1)
    if not there.any():
        return np.zeros(len(points))
    distance, nearest = kd_tree(centers[there]).query(points, distance_upper_bound=0.003)
    near = np.isfinite(distance)
    spots = np.zeros(len(points))
    own = nearest[near]
    reach = 1.25 - distance[near] / radius[there][own]
    spots[near] = depth[there][own] * np.clip(2.0 * reach, 0.0, 1.0)
    return spots


def wrinkles(points: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """A net of fine folds, mostly across the fingers' direction: (N,), 0-1.

    Takes `points` (N, 3) m on the rest hand.
    """
    stretched = points * np.array([1.7, 0.8, 0.8])
    folds = np.zeros(len(points))
    for scale, strength in ((0.012, 1.0), (0.006, 0.6)):
        level = fractal_noise(stretched, scale, rng, octaves=2)
        folds = np.maximum(folds, strength * np.exp(-((level / 0.13) ** 2)))
    return folds


def hair(
    points: np.ndarray,
    normals: np.ndarray,
    share: np.ndarray,
    amount: float,
    rng: np.random.Generator,
) -> np.ndarray:
    """Fine strokes that follow the skin towards the finger tips and the little finger's side.

    Takes `points` (N, 3) m on the rest hand, `normals` (N, 3) unit, `share` (N,) 0-1. Returns (N,)
    0 (none) to 1 (covered by hair).
    """
    strokes = np.zeros(len(points))
    total = float(share.sum())
    if total <= 0.0:
        return strokes
    tree = kd_tree(points)
    probe = rng.integers(0, len(points), 400)
    spacing = float(np.median(tree.query(points[probe], k=2)[0][:, 1]))
    count = int(amount * _HAIRS * 1e4 * total * spacing**2)
    at = rng.choice(len(points), size=count, p=share / total)
    sway = fractal_noise(points, 0.03, rng, octaves=2)
    bend = sway[at] * 0.5 + rng.normal(0.0, 0.35, count)
    length = rng.uniform(0.35, 1.0, count) * (0.4 + 0.6 * share[at])
    curl = rng.normal(0.0, 0.035, count)
    darkness = rng.uniform(0.5, 1.0, count)
    place = points[at]
    for step in range(_STEPS):
        growing = step < length * _STEPS
        taper = darkness * (1.0 - 0.6 * step / (length * _STEPS))
        np.maximum.at(strokes, at[growing], taper[growing])
        angle = bend + curl * step
        way = np.stack([-np.cos(angle - 0.75), np.zeros(count), np.sin(angle - 0.75)], axis=1)
        normal = normals[at]
        way = unit(way - np.einsum("ni,ni->n", way, normal)[:, None] * normal)
        place = place + _STEP * way
        _, at = tree.query(place)
        # Back onto the skin, or the stroke would leave it where it curves.
        height = np.einsum("ni,ni->n", place - points[at], normals[at])
        place = place - height[:, None] * normals[at]
    # None walks on to where hair does not grow.
    return np.where(share > 0.0, strokes, 0.0)


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


def sample_skin(anatomy: Anatomy, subject: Subject) -> SkinSample:
    """Paint skin at the places of an anatomy."""
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


# Absorption of more blood and of more yellow (carotene, bilirubin), per linear channel.
# Source: the bands of haemoglobin (540-580 nm) and of carotene (450-490 nm), as seen by sRGB.
_BLOOD = np.array([0.02, 0.42, 0.34])
_YELLOW = np.array([0.12, 0.11, 0.34])
_MELANIN = np.array([0.55, 0.95, 1.2])


def of_side(subject: Subject, side: str) -> Subject:
    """The subject with what one hand wears; hands that look alike give equal subjects."""
    return replace(subject, looks=subject.looks.on(side))


def painted(anatomy: Anatomy, subject: Subject, *, fine: bool) -> SkinSample:
    """Paint one hand of a subject at the places of an anatomy."""
    skin = sample_skin(anatomy, subject)
    looks = subject.looks
    if looks == PLAIN:
        return skin
    if fine:
        skin = _marked(anatomy, subject, skin)
    for tattoo in looks.tattoos if fine else ():
        ink = 0.86 * tattoo_cover(anatomy, tattoo)[:, None]
        dark = srgb_to_linear(np.array(tattoo.ink)) * np.minimum(skin.albedo + 0.35, 1.0)
        skin = replace(skin, albedo=skin.albedo + ink * (dark - skin.albedo))
    if fine and looks.hair:
        skin = _hairy(anatomy, subject, skin)
    for polish in looks.polish if fine else ():
        skin = _polished(anatomy, polish, skin)
    for glove in looks.gloves:
        skin = gloved(anatomy, glove, skin, fine=fine)
    return skin


def _marked(anatomy: Anatomy, subject: Subject, skin: SkinSample) -> SkinSample:
    """Blood, yellow, freckles and wrinkles."""
    looks, back = subject.looks, anatomy.back
    nail = anatomy.nails()[0]
    albedo = skin.albedo * np.exp(-looks.blood * _BLOOD - looks.yellow * _YELLOW)
    height = skin.height
    if looks.freckles:
        spots = freckles(anatomy.points, looks.freckles, generator(subject.seed, "freckles"))
        spots = spots * back * (1.0 - nail)
        albedo = albedo * np.exp(-0.85 * spots[:, None] * _MELANIN)
    if looks.wrinkles:
        folds = wrinkles(anatomy.points, generator(subject.seed, "wrinkles")) * back
        lines, _ = anatomy.joint_creases(generator(subject.seed, "creases"))
        folds = looks.wrinkles * (0.7 * folds + 0.8 * lines * back) * (1.0 - nail)
        height = height - 0.00024 * folds
        albedo = albedo * np.exp(-0.32 * folds[:, None] * np.array([0.55, 0.9, 1.0]))
    return replace(skin, albedo=np.clip(albedo, 0.01, 0.95), height=height)


def _hairy(anatomy: Anatomy, subject: Subject, skin: SkinSample) -> SkinSample:
    first = [FIRST_JOINT[finger] for finger in FINGERS]
    grown = anatomy.weights[:, 0] + 0.75 * anatomy.weights[:, first].sum(axis=1)
    forward = anatomy.joints[4] - anatomy.joints[0]
    along = (anatomy.points - anatomy.joints[0]) @ forward / (forward @ forward)
    # More towards the wrist and the arm, and some around the arm's inner side.
    more = np.clip(0.75 - 0.5 * along, 0.25, 1.3)
    around = np.clip(1.5 * anatomy.back - 0.45, 0.0, 1.0) + 0.3 * np.clip(-along - 0.15, 0.0, 1.0)
    strokes = hair(
        anatomy.points,
        anatomy.normals,
        np.clip(grown * more * around, 0.0, 1.0),
        subject.looks.hair,
        generator(subject.seed, "hair"),
    )
    color = srgb_to_linear(np.array(subject.looks.hair_color))
    cover = 0.7 * strokes[:, None]
    return replace(
        skin,
        albedo=skin.albedo + cover * (color - skin.albedo),
        height=skin.height + 0.00003 * strokes,
    )
