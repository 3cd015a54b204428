"""Surfaces before the camera at one instant: hands, sleeves or arms, what is worn, objects."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np

from hwp_bench.base.colors import srgb_to_linear
from hwp_bench.sim.effects.effects import Placement
from hwp_bench.sim.geometry.rays import RenderCost, Tracer
from hwp_bench.sim.geometry.surface import (
    Material,
    Surface,
    join,
    surface_normals,
    transformed,
    unit,
)
from hwp_bench.sim.light.lights import focus_point
from hwp_bench.sim.light.shading import openness
from hwp_bench.sim.props.objects import build_object
from hwp_bench.sim.scene.motion import HandMoment, hand_parameters, heading_matrix, scene_hands
from hwp_bench.sim.scene.scene import Scene
from hwp_bench.sim.subject.arms import (
    arm_atlas,
    arm_openness,
    forearm,
    seamless,
    sleeve,
    sleeve_material,
    wrist_loop,
    wrist_rim,
)
from hwp_bench.sim.subject.atlas import SkinAtlas, skin_atlas
from hwp_bench.sim.subject.covers import covered
from hwp_bench.sim.subject.hand import FINE, anatomy_at, subject_hand
from hwp_bench.sim.subject.skin import of_side
from hwp_bench.sim.subject.subject import Subject

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
    """Build a person's parts: first the hands, then a sleeve or an arm for each, then the rest."""
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
    from hwp_bench.sim.subject.mounts import ring_mounts, wrist_mounts

    rings = [Part(side, item.carried(skin.vertices)) for item in ring_mounts(subject, side)]
    others = [
        Part("", item.carried((arm if item.on_arm else skin).vertices))
        for item in wrist_mounts(subject, side, subdivisions)
    ]
    return rings + others


def person_openness(
    subject: Subject, shares: dict[str, np.ndarray], count: int, subdivisions: int = FINE
) -> np.ndarray:
    """Share of the sky that a person's vertices see: (count,), 0-1."""
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


@dataclass(frozen=True, eq=False)
class Body:
    """Hands, sleeves and what is worn, at one instant."""

    #: All of them as one surface.
    surface: Surface
    #: The same, ready for rays.
    tracer: Tracer


class Stage:
    """Builds what a scene shows."""

    def __init__(self, scene: Scene, cost: RenderCost) -> None:
        self.scene = scene
        self.cost = cost

    def parameters(self, hands: dict[str, HandMoment]) -> dict[str, tuple[np.ndarray, np.ndarray]]:
        """Pose (16, 3) rad and transl (3,) m of every hand."""
        focus = focus_point()
        return {
            side: hand_parameters(moment, side, subject.joints, focus)
            for (side, moment), subject in zip(
                hands.items(), scene_hands(self.scene).values(), strict=True
            )
        }

    def surface(
        self,
        hands: dict[str, HandMoment],
        subdivisions: int = FINE,
        parameters: dict[str, tuple[np.ndarray, np.ndarray]] | None = None,
    ) -> Surface:
        """Hands, sleeves and what is worn, posed."""
        return join([part.surface for part in self._parts(hands, subdivisions, parameters)])

    def owners(self, hands: dict[str, HandMoment]) -> np.ndarray:
        """Who owns each face of `surface(hands)`, as `OWNERS` numbers them: (F,)."""
        parts = self._parts(hands, FINE, None)
        return np.concatenate(
            [np.full(len(part.surface.faces), OWNERS[part.side]) for part in parts]
        )

    def _parts(
        self,
        hands: dict[str, HandMoment],
        subdivisions: int,
        parameters: dict[str, tuple[np.ndarray, np.ndarray]] | None,
    ) -> list[Part]:
        parameters = parameters or self.parameters(hands)
        return person_parts(self.scene.subject, hands, parameters, subdivisions)

    def traced(self, surface: Surface) -> Body:
        """A surface made ready for rays."""
        return Body(surface, Tracer(surface.vertices, surface.faces, self.cost.rays))

    def seen_sky(self, body: Body) -> dict[str, np.ndarray]:
        """Share of the sky that the template's vertices see, by side: (T,) each."""
        seen, start = {}, 0
        for side, subject in scene_hands(self.scene).items():
            coarse = slice(start, start + len(subject.template.vertices))
            seen[side] = openness(
                body.tracer, body.surface.vertices[coarse], body.surface.normals[coarse]
            )
            start += subject.lift.shape[0]
        return seen

    def under_sky(
        self, surface: Surface, seen: dict[str, np.ndarray], subdivisions: int = FINE
    ) -> Surface:
        """The surface with the share of the sky that each of its vertices sees."""
        subjects = scene_hands(self.scene, subdivisions)
        shares = {side: subjects[side].lift @ share for side, share in seen.items()}
        count = len(surface.vertices)
        sky = person_openness(self.scene.subject, shares, count, subdivisions)
        return replace(surface, openness=sky)

    def things(
        self, placements: tuple[Placement, ...], hands: dict[str, HandMoment]
    ) -> Body | None:
        """The objects of an instant, ready for rays, or None."""
        if not placements:
            return None
        with self.cost.time("objects"):
            return self.traced(self.objects(placements, hands))

    def objects(self, placements: tuple[Placement, ...], hands: dict[str, HandMoment]) -> Surface:
        """The objects of an instant, at least one, as one surface."""
        parts = []
        for placement in placements:
            frame = np.eye(4)
            frame[:3, 3] = focus_point()
            if placement.anchor != "world":
                moment = hands[placement.anchor]
                still = heading_matrix(np.zeros(3), placement.anchor)
                frame[:3, :3] = heading_matrix(moment.heading, placement.anchor) @ still.T
                frame[:3, 3] += moment.place
            parts.append(
                transformed(
                    build_object(placement.name, placement.variant), frame @ placement.transform
                )
            )
        return join(parts)


def between(bodies: tuple[Surface, Surface, Surface], s: float | np.ndarray) -> Surface:
    """A surface between three instants of the same hands."""
    first, middle, last = bodies
    a, b, c = 2.0 * s * s - s, 1.0 - 4.0 * s * s, 2.0 * s * s + s
    return replace(
        middle,
        vertices=a * first.vertices + b * middle.vertices + c * last.vertices,
        normals=unit(a * first.normals + b * middle.normals + c * last.normals),
    )
