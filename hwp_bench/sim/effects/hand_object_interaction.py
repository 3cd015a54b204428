"""Objects that the hands hold, touch or pass, and that cover and shade them."""

from __future__ import annotations

import numpy as np

from hwp_bench.sim.effects.base import Effect, Placement
from hwp_bench.sim.props.objects import ObjectRequest
from hwp_bench.sim.scene.effect_settings import ObjectInteraction, keys_by_side, read_settings
from hwp_bench.sim.scene.episodes import envelope
from hwp_bench.sim.scene.motion import HandMoment, moment_of_key
from hwp_bench.sim.scene.schema import EffectCall, Scene


class _HandObjectInteraction(Effect):
    name = "hand_object_interaction"
    #: 0 leaves the objects where they come from, 1 brings them to their place.
    default_strengths = (0.25, 0.45, 0.65, 0.85, 1.0)
    max_strength = 1.0

    def passes(self, scene: Scene) -> tuple[str, ...]:
        return ("objects",)

    def stage(
        self, scene: Scene, call: EffectCall, seconds: float, hands: dict[str, HandMoment]
    ) -> dict[str, HandMoment]:
        settings = read_settings(ObjectInteraction, call, scene.id)
        staged = keys_by_side(settings.stage, scene.sides, call.kind, scene.id)
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

        # Objects keep their front: +z of an object faces the camera, its top is up.
        flip = np.diag([1.0, -1.0, -1.0])
        placements = []
        for item in read_settings(ObjectInteraction, call, scene.id).items:
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
            anchor = item.anchor or scene.sides[0]
            placements.append(
                Placement(ObjectRequest(item.object, item.variant), anchor, transform)
            )
        return tuple(placements)

    def estimate_error(self, strength: float) -> tuple[float, float]:
        return 0.06 * strength, 0.003 * strength


EFFECT = _HandObjectInteraction()
