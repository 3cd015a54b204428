"""Skin with everything that the subject's looks add to it; without looks it is plain skin."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from hwp_bench.base.colors import srgb_to_linear
from hwp_bench.hands.poses import FIRST_JOINT
from hwp_bench.hands.skeleton import FINGERS
from hwp_bench.sim.geometry.noise import generator
from hwp_bench.sim.scene.looks import PLAIN, Polish
from hwp_bench.sim.scene.schema import Subject
from hwp_bench.sim.subject.anatomy import Anatomy
from hwp_bench.sim.subject.gloves import gloved
from hwp_bench.sim.subject.marks import freckles, hair, wrinkles
from hwp_bench.sim.subject.skin import SkinSample, sample_skin
from hwp_bench.sim.subject.tattoos import tattoo_cover

# Absorption of more blood and of more yellow (carotene, bilirubin), per linear channel.
# Source: the bands of haemoglobin (540-580 nm) and of carotene (450-490 nm), as seen by sRGB.
_BLOOD = np.array([0.02, 0.42, 0.34])
_YELLOW = np.array([0.12, 0.11, 0.34])
_MELANIN = np.array([0.55, 0.95, 1.2])


def of_side(subject: Subject, side: str) -> Subject:
    """The subject with what one hand wears; hands that look alike give equal subjects."""
    return replace(subject, looks=subject.looks.on(side))


def painted(anatomy: Anatomy, subject: Subject, *, fine: bool) -> SkinSample:
    """Paint one hand of a subject at the places of an anatomy.

    Args:
        anatomy: where the places are on the hand.
        subject: as `of_side` gives it.
        fine: also what only a dense sampling can hold: hairs, threads, the folds of wrinkles.
    """
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


def _polished(anatomy: Anatomy, polish: Polish, skin: SkinSample) -> SkinSample:
    plate = np.clip(1.4 * anatomy.nails()[0], 0.0, 1.0)
    owned = [
        anatomy.weights[:, FIRST_JOINT[finger] : FIRST_JOINT[finger] + 3].sum(axis=1)
        for finger in FINGERS
    ]
    colors = srgb_to_linear(np.array(polish.colors))
    color = colors[np.argmax(owned, axis=0)] if len(colors) > 1 else colors[0]
    return SkinSample(
        albedo=skin.albedo + 0.97 * plate[:, None] * (color - skin.albedo),
        height=skin.height + 0.00008 * plate,
        roughness=skin.roughness + plate * (0.6 - 0.45 * polish.gloss - skin.roughness),
    )
