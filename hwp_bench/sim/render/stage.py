"""Surfaces before the camera at one instant: hands, sleeves and objects."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np

from hwp_bench.base.colors import srgb_to_linear
from hwp_bench.sim.effects.base import Placement
from hwp_bench.sim.geometry.mesh import unit
from hwp_bench.sim.geometry.raycast import RenderCost, Tracer
from hwp_bench.sim.geometry.surface import Material, Surface, join, transformed
from hwp_bench.sim.render.shading import openness
from hwp_bench.sim.scene.motion import HandMoment, hand_parameters, heading_matrix
from hwp_bench.sim.scene.optics import focus_point
from hwp_bench.sim.scene.schema import Scene, Subject
from hwp_bench.sim.subject.atlas import skin_atlas
from hwp_bench.sim.subject.hand import FINE, SubjectHand, scene_hands, subject_hand
from hwp_bench.sim.subject.sleeve import sleeve, sleeve_material, wrist_rim

# How far light wraps around the terminator inside skin, per linear channel.
_WRAP = (0.28, 0.12, 0.07)


@dataclass(frozen=True, eq=False)
class Body:
    """Hands and sleeves at one instant."""

    #: All of them as one surface.
    surface: Surface
    #: The same, ready for rays.
    tracer: Tracer


class Stage:
    """Builds what a scene shows.

    Args:
        scene: the scene.
        cost: is charged with the time and the rays.
    """

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
        """Hands and sleeves, posed.

        Args:
            hands: what the hands do.
            subdivisions: of the hands' mesh.
            parameters: pose and translation instead of the ones that follow from `hands`.
        """
        parameters = parameters or self.parameters(hands)
        cloth = sleeve_material(self.scene.subject.sleeve, self.scene.subject.seed)
        subjects = scene_hands(self.scene, subdivisions)
        focus = focus_point()
        skins, sleeves = [], []
        for side, moment in hands.items():
            subject = subjects[side]
            vertices, normals = subject.pose(*parameters[side])
            skins.append(_hand_surface(subject, vertices, normals, _skin(self.scene.subject, side)))
            rim = vertices[wrist_rim(subject.template)]
            turn = heading_matrix(moment.heading, side)
            forward = turn @ np.array([-1.0 if side == "right" else 1.0, 0.0, 0.0])
            sleeves.append(sleeve(rim, forward, focus + _elbow(side), cloth))
        return join(skins + sleeves)

    def traced(self, surface: Surface) -> Body:
        """A surface made ready for rays."""
        return Body(surface, Tracer(surface.vertices, surface.faces, self.cost.rays))

    def seen_sky(self, body: Body) -> dict[str, np.ndarray]:
        """Share of the sky that the template's vertices see, by side: (T,) each.

        Args:
            body: hands of `FINE` subdivisions.
        """
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
        parts = [subjects[side].lift @ share for side, share in seen.items()]
        sleeves = np.ones(len(surface.vertices) - sum(len(part) for part in parts))
        return replace(surface, openness=np.clip(np.concatenate([*parts, sleeves]), 0.0, 1.0))

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
        from hwp_bench.sim.props.objects import build_object

        parts = []
        for placement in placements:
            frame = np.eye(4)
            frame[:3, 3] = focus_point()
            if placement.anchor != "world":
                moment = hands[placement.anchor]
                still = heading_matrix(np.zeros(3), placement.anchor)
                frame[:3, :3] = heading_matrix(moment.heading, placement.anchor) @ still.T
                frame[:3, 3] += moment.place
            parts.append(transformed(build_object(placement.request), frame @ placement.transform))
        return join(parts)


def between(bodies: tuple[Surface, Surface, Surface], s: float | np.ndarray) -> Surface:
    """A surface between three instants of the same hands.

    Args:
        bodies: at the opening, the middle and the closing of the shutter.
        s: -0.5 to 0.5; the parabola through the three. Or (V, 1), one for each vertex.
    """
    first, middle, last = bodies
    a, b, c = 2.0 * s * s - s, 1.0 - 4.0 * s * s, 2.0 * s * s + s
    return replace(
        middle,
        vertices=a * first.vertices + b * middle.vertices + c * last.vertices,
        normals=unit(a * first.normals + b * middle.normals + c * last.normals),
    )


def _hand_surface(
    subject: SubjectHand, vertices: np.ndarray, normals: np.ndarray, skin: Material
) -> Surface:
    return Surface(
        vertices=vertices,
        normals=normals,
        faces=subject.faces,
        corner_uv=subject.corner_uv,
        material=np.zeros(len(subject.faces), dtype=np.int64),
        materials=(skin,),
        hand=np.ones(len(subject.faces), dtype=bool),
    )


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
    atlas = skin_atlas(subject)
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
