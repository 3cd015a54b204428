"""Subjects off the hand model: how far it is from them, for people and for the capture's files."""

from __future__ import annotations

from typing import Any

from hwp_bench.base.tables import Cell, Column, Table
from hwp_bench.sim.scene.schema import Scene
from hwp_bench.sim.subject.hand import scene_hands
from hwp_bench.sim.subject.person import is_off_template
from hwp_bench.sim.subject.template_distance import TemplateDistance, template_distance

_TITLE = "Subjects off the hand model: distance of its surface at the true betas, at rest"


def distances(scene: Scene) -> dict[str, TemplateDistance]:
    """Distance of the hand model from each hand of a scene; empty for one that it describes."""
    if not is_off_template(scene.subject):
        return {}
    return {side: template_distance(hand) for side, hand in scene_hands(scene).items()}


def subject_json(scene: Scene) -> dict[str, dict[str, Any]]:
    """The same as JSON values, by side."""
    return {side: found.to_json() for side, found in distances(scene).items()}


def subject_table(found: dict[str, dict[str, TemplateDistance]]) -> Table:
    """One row for each hand.

    Args:
        found: `distances` by the name of the scene.
    """
    rows: list[tuple[Cell, ...]] = [
        (
            name,
            side,
            item.surface,
            item.mean_mm,
            item.most_mm,
            item.largest_mm,
            item.joints_mm,
            item.farthest_joint_mm,
        )
        for name, hands in found.items()
        for side, item in hands.items()
    ]
    numbers = ("mean, mm", "95 %", "largest", "joints, mean mm", "farthest joint")
    names = ("scene", "hand", "surface")
    return Table(
        _TITLE,
        (*(Column(name) for name in names), *(Column(name, digits=1) for name in numbers)),
        tuple(rows),
    )
