"""Hands or camera that move while the shutter is open."""

from __future__ import annotations

import numpy as np

from hwp_bench.sim.effects.base import Effect, Shutter
from hwp_bench.sim.fields import Fields
from hwp_bench.sim.scene import EffectCall, Scene
from hwp_bench.sim.seeds import generator


def _read(call: EffectCall, where: str) -> tuple[float, float]:
    fields = Fields(call.settings, where, "effects(motion_blur).")
    shutter = fields.number("shutter", 0.001, 0.5, default=0.02)
    camera = fields.number("camera_share", 0.0, 1.0, default=0.0)
    fields.finish()
    return shutter, camera


class _MotionBlur(Effect):
    name = "motion_blur"
    #: Length of the streak, fraction of the picture's width.
    default_strengths = (0.008, 0.018, 0.034, 0.06, 0.1)
    max_strength = 0.25

    def passes(self, scene: Scene) -> tuple[str, ...]:
        return ("shutter",)

    def check(self, scene: Scene, call: EffectCall, where: str) -> None:
        _read(call, where)

    def shutter(
        self, scene: Scene, call: EffectCall, seconds: float, strength: float
    ) -> Shutter | None:
        seconds_open, share = _read(call, scene.id)
        angle = _slow_angle(scene, seconds)
        way = strength * np.array([np.cos(angle), np.sin(angle)])
        camera = share * strength * np.array([np.cos(1.7 * angle + 1.0), np.sin(1.7 * angle + 1.0)])
        return Shutter(
            seconds=seconds_open,
            hand=(float(way[0]), float(way[1])),
            camera=(float(camera[0]), float(camera[1])),
            twist=150.0 * strength * float(np.sin(2.3 * angle)),
        )

    def estimate_error(self, strength: float) -> tuple[float, float]:
        return 0.5 * strength, 0.04 * strength


def _slow_angle(scene: Scene, seconds: float) -> float:
    """Direction of the shaking, which turns a few times a second."""
    rates = generator(scene.seed, "shake").uniform(1.0, 3.0, 2)
    return float(np.pi * np.sin(rates[0] * seconds) + 2.0 * np.sin(rates[1] * seconds + 1.0))


EFFECT = _MotionBlur()
