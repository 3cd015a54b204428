"""Surfaces before the camera at one instant: hands, sleeves or arms, what is worn, objects."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np

from hwp_bench.base.colors import srgb_to_linear
from hwp_bench.sim.effects import Placement
from hwp_bench.sim.geometry.rays import RenderCost, Tracer
from hwp_bench.sim.geometry.surface import (
    Material,
    Surface,
    join,
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
from hwp_bench.sim.subject.hand import FINE, subject_hand
from hwp_bench.sim.subject.mounts import ring_mounts, wrist_mounts
from hwp_bench.sim.subject.skin import of_side
from hwp_bench.sim.subject.subject import Subject
from hwp_bench.sim.subject.wear import covered

# How far light wraps around the terminator inside skin, per linear channel.
_WRAP = (0.28, 0.12, 0.07)
# Place of the right elbow, m from the point looked at.
_ELBOW = np.array([0.10, 0.42, 0.02])
#: Who owns a part of the image: a hand, or nothing that counts as one.
OWNERS = {"right": 1, "left": 2, "": 3}


@dataclass(frozen=True, eq=False)
class Part:
    """A piece of a person."""

    #: The hand that it counts as, or empty.
    side: str
    #: The piece, posed.
    surface: Surface


def _hand_surface(
    subject: Subject, side: str, subdivisions: int, pose: np.ndarray, transl: np.ndarray
) -> Surface:
    """A posed hand: `pose` (16, 3) rad, `transl` (3,) m."""
    hand = subject_hand(subject, side, subdivisions)
    vertices, normals = hand.pose(pose, transl)
    skin = _skin(subject, side)
    surface = Surface(
        vertices=vertices,
        normals=normals,
        faces=hand.faces,
        corner_uv=hand.corner_uv,
        material=np.zeros(len(hand.faces), dtype=np.int64),
        materials=(skin,),
        hand=np.ones(len(hand.faces), dtype=bool),
    )
    if hand.texture is not None or not of_side(subject, side).looks.gloves:
        return surface
    # Light does not wrap around the terminator inside cloth.
    cloth = replace(skin, wrap=(0.0, 0.0, 0.0), specular=0.02)
    under = _gloved_faces(subject, side, subdivisions)
    return replace(surface, material=under, materials=(skin, cloth))


@lru_cache(maxsize=8)
def _gloved_faces(subject: Subject, side: str, subdivisions: int) -> np.ndarray:
    """(F,) 1 where most of a face is under a glove."""
    hand = subject_hand(subject, side, subdivisions)
    anatomy = hand.anatomy(hand.rest, hand.rest_normals, hand.lift @ hand.template.weights)
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
        """First the hands, then a sleeve or an arm for each, then what is worn."""
        subject = self.scene.subject
        parameters = parameters or self.parameters(hands)
        skins, arms, worn = [], [], []
        for side, moment in hands.items():
            skin = _hand_surface(subject, side, subdivisions, *parameters[side])
            mirror = 1.0 if side == "right" else -1.0
            forward = heading_matrix(moment.heading, side) @ np.array([-mirror, 0.0, 0.0])
            elbow = focus_point() + _ELBOW * np.array([mirror, 1.0, 1.0])
            if subject.looks.arm == "bare":
                rim = wrist_loop(subject, side, subdivisions)
                paint = _arm_skin(of_side(subject, side))
                arm = forearm(skin.vertices[rim.loop], rim.around, forward, elbow, paint)
                skin, arm = seamless(skin, arm, rim.loop)
            else:
                cloth = sleeve_material(subject.sleeve, subject.seed)
                loop = wrist_rim(subject_hand(subject, side, subdivisions).template)
                arm = sleeve(skin.vertices[loop], forward, elbow, cloth)
            skins.append(Part(side, skin))
            arms.append(Part("", arm))
            for item in ring_mounts(subject, side):
                worn.append(Part(side, item.carried(skin.vertices)))
            for item in wrist_mounts(subject, side, subdivisions):
                carrier = arm if item.on_arm else skin
                worn.append(Part("", item.carried(carrier.vertices)))
        return skins + arms + worn

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
        subject, subjects = self.scene.subject, scene_hands(self.scene, subdivisions)
        shares = {side: subjects[side].lift @ share for side, share in seen.items()}
        parts = list(shares.values())
        if subject.looks.arm == "bare":
            for side, share in shares.items():
                parts.append(arm_openness(share[wrist_loop(subject, side, subdivisions).loop]))
        others = np.ones(len(surface.vertices) - sum(len(part) for part in parts))
        sky = np.clip(np.concatenate([*parts, others]), 0.0, 1.0)
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
