"""Fast articulation and extreme angles, where an estimator errs more."""

from __future__ import annotations

from hwp_bench.sim.effects.base import Effect
from hwp_bench.sim.episodes import envelope
from hwp_bench.sim.fields import Fields
from hwp_bench.sim.motion import HandMoment, along_keys, moment_of_key
from hwp_bench.sim.scene import EffectCall, HandKey, Scene, hand_key


def _read(
    call: EffectCall, sides: tuple[str, ...], where: str
) -> tuple[float, dict[str, tuple[HandKey, ...]]]:
    fields = Fields(call.settings, where, "effects(complex_poses).")
    pace = fields.number("pace", 0.1, 10.0, default=1.6)
    keys = {side: tuple(hand_key(row) for row in fields.rows(side)) for side in sides}
    if not any(keys.values()):
        raise fields.wrong("right or left", "holds no key")
    fields.finish()
    return pace, keys


class _ComplexPoses(Effect):
    name = "complex_poses"
    #: Error of the estimated joint angles, rad.
    default_strengths = (0.02, 0.035, 0.055, 0.085, 0.13)
    max_strength = 0.2

    def check(self, scene: Scene, call: EffectCall, where: str) -> None:
        _read(call, scene.sides, where)

    def stage(
        self, scene: Scene, call: EffectCall, seconds: float, hands: dict[str, HandMoment]
    ) -> dict[str, HandMoment]:
        pace, keys = _read(call, scene.sides, scene.id)
        weight = envelope(call, seconds / scene.duration)
        changed = dict(hands)
        for side, rows in keys.items():
            if rows:
                row = [moment_of_key(key) for key in rows]
                label = f"complex-{side}"
                goal = along_keys(row, seconds * pace, scene, label, 8.0)
                changed[side] = hands[side].blend(goal, weight)
        return changed

    def estimate_error(self, strength: float) -> tuple[float, float]:
        return strength, 0.04 * strength


EFFECT = _ComplexPoses()
