"""A person before the camera at one instant: hands, sleeves or arms, and what is worn."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np

from hwp_bench.base.colors import srgb_to_linear
from hwp_bench.sim.geometry.mesh import surface_normals
from hwp_bench.sim.geometry.surface import Material, Surface
from hwp_bench.sim.scene.motion import HandMoment, heading_matrix
from hwp_bench.sim.scene.optics import focus_point
from hwp_bench.sim.scene.schema import Subject
from hwp_bench.sim.subject.atlas import SkinAtlas, skin_atlas
from hwp_bench.sim.subject.forearm import arm_atlas, arm_openness, forearm, seamless, wrist_loop
from hwp_bench.sim.subject.gloves import covered
from hwp_bench.sim.subject.hand import FINE, anatomy_at, subject_hand
from hwp_bench.sim.subject.painting import of_side
from hwp_bench.sim.subject.sleeve import sleeve, sleeve_material, wrist_rim

# How far light wraps around the terminator inside skin, per linear channel.
_WRAP = (0.28, 0.12, 0.07)
#: Who owns a part of the image: a hand, or nothing that counts as one.
OWNERS = {"right": 1, "left": 2, "": 3}


@dataclass(frozen=True, eq=False)
class Part:
    """A piece of a person."""

    #: The hand that it counts as, or empty.
    side: str
    #: The piece, posed.
    surface: Surface


def person_parts(
    subject: Subject,
    hands: dict[str, HandMoment],
    parameters: dict[str, tuple[np.ndarray, np.ndarray]],
    subdivisions: int = FINE,
) -> list[Part]:
    """Build a person's parts: first the hands, then a sleeve or an arm for each, then the rest.

    Args:
        subject: who.
        hands: what the hands do.
        parameters: pose (16, 3) rad and transl (3,) m of every hand.
        subdivisions: of the hands' mesh.
    """
    skins, arms, worn = [], [], []
    bare = subject.looks.arm == "bare"
    for side, moment in hands.items():
        hand = subject_hand(subject, side, subdivisions)
        skin = _hand_surface(subject, side, subdivisions, *hand.pose(*parameters[side]))
        turn = heading_matrix(moment.heading, side)
        forward = turn @ np.array([-1.0 if side == "right" else 1.0, 0.0, 0.0])
        elbow = focus_point() + _elbow(side)
        if bare:
            rim = wrist_loop(subject, side, subdivisions)
            paint = _arm_skin(of_side(subject, side))
            arm = forearm(skin.vertices[rim.loop], rim.around, forward, elbow, paint)
            skin, arm = seamless(skin, arm, rim.loop)
        else:
            cloth = sleeve_material(subject.sleeve, subject.seed)
            arm = sleeve(skin.vertices[wrist_rim(hand.template)], forward, elbow, cloth)
        skins.append(Part(side, skin))
        arms.append(Part("", arm))
        if subject.looks.rings or subject.looks.wrist:
            worn += _worn(subject, side, skin, arm, subdivisions)
    return skins + arms + worn


def _worn(
    subject: Subject, side: str, skin: Surface, arm: Surface, subdivisions: int
) -> list[Part]:
    # Only a person who wears something needs the modules that build it.
    from hwp_bench.sim.subject.worn import ring_mounts, wrist_mounts

    rings = [Part(side, item.carried(skin.vertices)) for item in ring_mounts(subject, side)]
    others = [
        Part("", item.carried((arm if item.on_arm else skin).vertices))
        for item in wrist_mounts(subject, side, subdivisions)
    ]
    return rings + others


def person_openness(
    subject: Subject, shares: dict[str, np.ndarray], count: int, subdivisions: int = FINE
) -> np.ndarray:
    """Share of the sky that a person's vertices see: (count,), 0-1.

    Args:
        subject: who.
        shares: by side, what the vertices of the hands see.
        count: vertices of all parts.
        subdivisions: of the hands' mesh.
    """
    parts = list(shares.values())
    if subject.looks.arm == "bare":
        for side, share in shares.items():
            parts.append(arm_openness(share[wrist_loop(subject, side, subdivisions).loop]))
    others = np.ones(count - sum(len(part) for part in parts))
    return np.clip(np.concatenate([*parts, others]), 0.0, 1.0)


def _hand_surface(
    subject: Subject, side: str, subdivisions: int, vertices: np.ndarray, normals: np.ndarray
) -> Surface:
    hand = subject_hand(subject, side, subdivisions)
    skin = _skin(subject, side)
    materials: tuple[Material, ...] = (skin,)
    material = np.zeros(len(hand.faces), dtype=np.int64)
    if hand.texture is None and of_side(subject, side).looks.gloves:
        # Light does not wrap around the terminator inside cloth.
        materials = (skin, replace(skin, wrap=(0.0, 0.0, 0.0), specular=0.02))
        material = _gloved_faces(subject, side, subdivisions)
    return Surface(
        vertices=vertices,
        normals=normals,
        faces=hand.faces,
        corner_uv=hand.corner_uv,
        material=material,
        materials=materials,
        hand=np.ones(len(hand.faces), dtype=bool),
    )


@lru_cache(maxsize=8)
def _gloved_faces(subject: Subject, side: str, subdivisions: int) -> np.ndarray:
    """(F,) 1 where most of a face is under a glove."""
    hand = subject_hand(subject, side, subdivisions)
    template = hand.template
    rest = hand.rest
    normals = surface_normals(rest, hand.faces, hand.normal_sum)
    weights = hand.lift @ template.weights
    anatomy = anatomy_at(template, hand.betas, rest, normals, weights, hand.joints)
    glove = of_side(subject, side).looks.gloves[0]
    return (covered(anatomy, glove)[hand.faces].mean(axis=1) > 0.5).astype(np.int64)


@lru_cache(maxsize=4)
def _skin(subject: Subject, side: str) -> Material:
    texture = subject_hand(subject, side).texture
    if texture is not None:
        return Material(
            albedo=srgb_to_linear(texture / 255.0).astype(np.float32),
            gloss=0.55,
            specular=0.028,
            wrap=_WRAP,
        )
    return _painted_skin(skin_atlas(of_side(subject, side)))


@lru_cache(maxsize=4)
def _arm_skin(subject: Subject) -> Material:
    return _painted_skin(arm_atlas(subject))


def _painted_skin(atlas: SkinAtlas) -> Material:
    return Material(
        albedo=atlas.albedo,
        roughness=atlas.roughness,
        specular=0.028,
        height=atlas.height,
        wrap=_WRAP,
    )


def _elbow(side: str) -> np.ndarray:
    """Place of the elbow, m from the point looked at."""
    mirror = 1.0 if side == "right" else -1.0
    return np.array([0.10 * mirror, 0.42, 0.02])
