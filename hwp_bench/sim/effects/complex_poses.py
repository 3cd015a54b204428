"""Fast articulation and extreme angles, where an estimator errs more."""

from __future__ import annotations

from hwp_bench.sim.effects.base import Effect
from hwp_bench.sim.scene.effect_settings import ComplexPoses, keys_by_side, read_settings
from hwp_bench.sim.scene.episodes import envelope
from hwp_bench.sim.scene.motion import HandMoment, along_keys, moment_of_key
from hwp_bench.sim.scene.schema import EffectCall, Scene


class _ComplexPoses(Effect):
    name = "complex_poses"
    #: Error of the estimated joint angles, rad.
    default_strengths = (0.02, 0.035, 0.055, 0.085, 0.13)
    max_strength = 0.2

    def stage(
        self, scene: Scene, call: EffectCall, seconds: float, hands: dict[str, HandMoment]
    ) -> dict[str, HandMoment]:
        settings = read_settings(ComplexPoses, call, scene.id)
        keys = keys_by_side(settings, scene.sides, call.kind, scene.id)
        weight = envelope(call, seconds / scene.duration)
        changed = dict(hands)
        for side, rows in keys.items():
            if rows:
                row = [moment_of_key(key) for key in rows]
                label = f"complex-{side}"
                goal = along_keys(row, seconds * settings.pace, scene, label, 8.0)
                changed[side] = hands[side].blend(goal, weight)
        return changed

    def estimate_error(self, strength: float) -> tuple[float, float]:
        return strength, 0.04 * strength


EFFECT = _ComplexPoses()
