"""Hands or camera that move while the shutter is open."""

from __future__ import annotations

import numpy as np

from hwp_bench.sim.effects.base import Effect, Shutter
from hwp_bench.sim.geometry.noise import generator
from hwp_bench.sim.scene.effect_settings import MotionBlur, read_settings
from hwp_bench.sim.scene.schema import EffectCall, Scene


class _MotionBlur(Effect):
    name = "motion_blur"
    #: Length of the streak, fraction of the image's width.
    default_strengths = (0.008, 0.018, 0.034, 0.06, 0.1)
    max_strength = 0.25

    def passes(self, scene: Scene) -> tuple[str, ...]:
        return ("shutter",)

    def shutter(
        self, scene: Scene, call: EffectCall, seconds: float, strength: float
    ) -> Shutter | None:
        settings = read_settings(MotionBlur, call, scene.id)
        angle = _slow_angle(scene, seconds)
        way = strength * np.array([np.cos(angle), np.sin(angle)])
        camera = (
            settings.camera_share
            * strength
            * np.array([np.cos(1.7 * angle + 1.0), np.sin(1.7 * angle + 1.0)])
        )
        return Shutter(
            seconds=settings.shutter,
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
