"""How far the hand model is from a subject that it does not describe."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from hwp_bench.base.numerics import kd_tree
from hwp_bench.sim.scene.motion import palm_of

if TYPE_CHECKING:
    from hwp_bench.sim.subject.hand import SubjectHand

# Triangles of the hand model that are tried for each point.
_TRIED = 24
# What lies so far before the wrist's joint counts, m: sleeves hide the rest.
_BEFORE = 0.01


@dataclass(frozen=True)
class TemplateDistance:
    """How far the hand model is from a subject at rest, with the betas that are its truth."""

    #: The surface.
    surface: str
    #: Mean way from the subject's surface to the hand model's, mm.
    mean_mm: float
    #: What 95 % of the surface stay below, mm.
    most_mm: float
    #: Largest, mm.
    largest_mm: float
    #: Mean distance of the places about which the fingers bend, mm.
    joints_mm: float
    #: The largest of these distances, mm.
    farthest_joint_mm: float
    #: The betas.
    betas: tuple[float, ...]

    def to_json(self) -> dict[str, Any]:
        """Return JSON values."""
        return asdict(self)


def template_distance(hand: SubjectHand) -> TemplateDistance:
    """Measure a subject at rest against the hand model with the subject's betas.

    Args:
        hand: the subject's hand.
    """
    from trimesh.triangles import closest_point

    model = hand.model
    shaped = model.vertices + model.shape_basis @ hand.betas
    places, _ = hand.pose(np.zeros((16, 3)), np.zeros(3))
    forward = -1.0 if model.side == "right" else 1.0
    # As in a capture, the middle of both palms is in the same place.
    aside = palm_of(hand.model_joints) - palm_of(hand.joints)
    places = places[(places[:, 0] - hand.joints[0, 0]) * forward > _BEFORE] + aside
    triangles = shaped[model.faces]
    _, near = kd_tree(triangles.mean(axis=1)).query(places, k=_TRIED)
    nearest = closest_point(triangles[near.reshape(-1)], np.repeat(places, _TRIED, axis=0))
    way = np.linalg.norm(nearest.reshape(len(places), _TRIED, 3) - places[:, None], axis=2)
    distance = 1000.0 * way.min(axis=1)
    bends = hand.template.joints + hand.template.joint_basis @ hand.betas + aside
    joints = 1000.0 * np.linalg.norm(bends - hand.model_joints, axis=1)[1:]
    return TemplateDistance(
        surface=hand.template.name,
        mean_mm=round(float(distance.mean()), 2),
        most_mm=round(float(np.quantile(distance, 0.95)), 2),
        largest_mm=round(float(distance.max()), 2),
        joints_mm=round(float(joints.mean()), 2),
        farthest_joint_mm=round(float(joints.max()), 2),
        betas=tuple(hand.betas.tolist()),
    )
