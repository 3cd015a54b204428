"""Objects that the hands hold, touch or pass, and that cover and shade them."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from hwp_bench.sim.effects.base import Effect, Placement
from hwp_bench.sim.episodes import envelope
from hwp_bench.sim.fields import Fields
from hwp_bench.sim.motion import HandMoment, moment_of_key
from hwp_bench.sim.objects import ObjectRequest, check_object
from hwp_bench.sim.scene import EffectCall, HandKey, Scene, hand_key


@dataclass(frozen=True)
class Item:
    """One object of a scene and how it moves."""

    #: Name of the object.
    object: str
    #: Its look.
    variant: int
    #: Hand that it moves with, or `world`.
    anchor: str
    #: m from the palm (or from the point looked at) at full strength.
    place: tuple[float, float, float]
    #: m from there at strength 0: where the object comes from.
    away: tuple[float, float, float]
    #: Degrees about x, y, z.
    rotate: tuple[float, float, float]
    #: Degrees per second about x, y, z.
    spin: tuple[float, float, float]
    #: m of swing along x, y, z, at `pace`.
    swing: tuple[float, float, float]
    #: Swings per second.
    pace: float
    #: Strength from which it is there.
    above: float


def _read(
    call_settings: Any, scene_sides: tuple[str, ...], where: str
) -> tuple[tuple[Item, ...], dict[str, HandKey]]:
    fields = Fields(call_settings, where, "effects(hand_object_interaction).")
    items = []
    zero = (0.0, 0.0, 0.0)
    for row in fields.rows("items"):
        name = row.text("object")
        check_object(name, where, row.name("object"))
        items.append(
            Item(
                object=name,
                variant=row.whole("variant", 0, 1000, default=0),
                anchor=row.choice("anchor", (*scene_sides, "world"), default=scene_sides[0]),
                place=row.vector("place", 1.0, default=zero),
                away=row.vector("away", 2.0, default=zero),
                rotate=row.vector("rotate", 360.0, default=zero),
                spin=row.vector("spin", 3600.0, default=zero),
                swing=row.vector("swing", 0.5, default=zero),
                pace=row.number("pace", 0.0, 20.0, default=0.5),
                above=row.number("above", 0.0, 1.0, default=0.0),
            )
        )
        row.finish()
    if not items:
        raise fields.wrong("items", "names no object")
    staged = {}
    table = fields.optional_table("stage")
    if table is not None:
        for side in scene_sides:
            key = table.optional_table(side)
            if key is not None:
                staged[side] = hand_key(key)
        table.finish()
    fields.finish()
    return tuple(items), staged


class _HandObjectInteraction(Effect):
    name = "hand_object_interaction"
    #: 0 leaves the objects where they come from, 1 brings them to their place.
    default_strengths = (0.25, 0.45, 0.65, 0.85, 1.0)
    max_strength = 1.0

    def passes(self, scene: Scene) -> tuple[str, ...]:
        return ("objects",)

    def check(self, scene: Scene, call: EffectCall, where: str) -> None:
        _read(call.settings, scene.sides, where)

    def stage(
        self, scene: Scene, call: EffectCall, seconds: float, hands: dict[str, HandMoment]
    ) -> dict[str, HandMoment]:
        _, staged = _settings(scene)
        weight = envelope(call, seconds / scene.duration)
        changed = dict(hands)
        for side, key in staged.items():
            goal = moment_of_key(key)
            # The wander of the track goes on, so that a staged hand is not frozen.
            goal = HandMoment(
                goal.angles + 0.15 * (hands[side].angles - goal.angles),
                goal.place + 0.1 * (hands[side].place - goal.place),
                goal.heading + 0.06 * (hands[side].heading - goal.heading),
            )
            changed[side] = hands[side].blend(goal, weight)
        return changed

    def objects(
        self, scene: Scene, call: EffectCall, seconds: float, strength: float
    ) -> tuple[Placement, ...]:
        from scipy.spatial.transform import Rotation

        items, _ = _settings(scene)
        # Objects keep their front: +z of an object faces the camera, its top is up.
        flip = np.diag([1.0, -1.0, -1.0])
        placements = []
        for item in items:
            if strength < item.above:
                continue
            wave = np.sin(2.0 * np.pi * item.pace * seconds + np.array([0.0, 0.6, 1.2]))
            transform = np.eye(4)
            angles = np.array(item.rotate) + np.array(item.spin) * seconds
            transform[:3, :3] = Rotation.from_euler("xyz", angles, degrees=True).as_matrix() @ flip
            transform[:3, 3] = (
                np.array(item.place)
                + (1.0 - strength) * np.array(item.away)
                + wave * np.array(item.swing)
            )
            placements.append(
                Placement(ObjectRequest(item.object, item.variant), item.anchor, transform)
            )
        return tuple(placements)

    def estimate_error(self, strength: float) -> tuple[float, float]:
        return 0.06 * strength, 0.003 * strength


def _settings(scene: Scene) -> tuple[tuple[Item, ...], dict[str, HandKey]]:
    call = scene.effect("hand_object_interaction")
    assert call is not None
    return _read(call.settings, scene.sides, scene.id)


EFFECT = _HandObjectInteraction()
