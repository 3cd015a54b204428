"""Surfaces before the camera at one instant: hands, sleeves and objects."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from hwp_bench.sim.effects.base import Placement
from hwp_bench.sim.geometry.mesh import unit
from hwp_bench.sim.geometry.raycast import RenderCost, Tracer
from hwp_bench.sim.geometry.surface import Surface, join, transformed
from hwp_bench.sim.render.person import OWNERS, Part, person_openness, person_parts
from hwp_bench.sim.render.shading import openness
from hwp_bench.sim.scene.motion import HandMoment, hand_parameters, heading_matrix
from hwp_bench.sim.scene.optics import focus_point
from hwp_bench.sim.scene.schema import Scene
from hwp_bench.sim.subject.hand import FINE, scene_hands


@dataclass(frozen=True, eq=False)
class Body:
    """Hands, sleeves and what is worn, at one instant."""

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
        """Hands, sleeves and what is worn, posed.

        Args:
            hands: what the hands do.
            subdivisions: of the hands' mesh.
            parameters: pose and translation instead of the ones that follow from `hands`.
        """
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
