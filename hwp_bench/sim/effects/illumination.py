"""Light that changes: exposure, colour temperature, direction of the key light, flicker."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from hwp_bench.base.colors import lamp_color
from hwp_bench.sim.effects.base import Effect
from hwp_bench.sim.geometry.mesh import unit
from hwp_bench.sim.scene.effect_settings import Illumination, read_settings
from hwp_bench.sim.scene.optics import CastShadow, Lights, focus_point
from hwp_bench.sim.scene.schema import EffectCall, Episode, Scene


class _Illumination(Effect):
    name = "illumination"
    #: 1 halves or doubles the exposure, or its equal in colour or direction.
    default_strengths = (0.15, 0.3, 0.5, 0.8, 1.2)
    max_strength = 2.5

    def passes(self, scene: Scene) -> tuple[str, ...]:
        return ("light",)

    def light(
        self, scene: Scene, call: EffectCall, seconds: float, strength: float, lights: Lights
    ) -> Lights:
        modes = read_settings(Illumination, call, scene.id).modes
        moment = seconds / scene.duration
        number = next((i for i, e in enumerate(call.episodes) if e.start <= moment <= e.end), 0)
        mode = modes[number % len(modes)]
        if mode in ("dim", "bright"):
            stops = -1.0 if mode == "dim" else 0.7
            return replace(lights, exposure=lights.exposure * 2.0 ** (stops * strength))
        if mode == "flicker":
            wave = np.sin(2.0 * np.pi * 3.1 * seconds) * np.sin(2.0 * np.pi * 1.3 * seconds + 1.0)
            return replace(lights, exposure=lights.exposure * 2.0 ** (strength * (wave - 0.4)))
        if mode in ("warm", "cool"):
            kelvin = 5500.0 * 2.0 ** ((-0.8 if mode == "warm" else 0.9) * strength)
            tint = lamp_color(kelvin) / lamp_color(5500.0)
            return lights.tinted(tint)
        if mode == "shadow":
            return replace(lights, cast=_passing_shadow(call.episodes[number], moment, strength))
        return _moved(lights, strength)

    def estimate_error(self, strength: float) -> tuple[float, float]:
        return 0.004 * strength, 0.0005 * strength


def _passing_shadow(episode: Episode, moment: float, strength: float) -> CastShadow:
    """A shadow that sweeps over the hands during an episode; black at strength 1.3."""
    through = (moment - episode.start) / (episode.end - episode.start)
    return CastShadow(
        across=unit(np.array([1.0, 0.35, 0.0])),
        edge=0.12 * (1.0 - 4.0 * min(through, 1.0 - through)),
        width=0.03,
        depth=min(1.0, strength / 1.3),
    )


def _moved(lights: Lights, strength: float) -> Lights:
    """All lamps swung around the vertical, 70 degrees at strength 1; the key light lowered too."""
    from scipy.spatial.transform import Rotation

    swing = Rotation.from_euler("y", 70.0 * strength, degrees=True)
    direction = swing.apply(lights.direction) + np.array([0.0, 0.25 * strength, 0.0])
    turn, focus = swing.as_matrix(), focus_point()
    lamps = tuple(lamp.turned(turn, focus) for lamp in lights.lamps)
    return replace(lights, direction=unit(direction), lamps=lamps)


EFFECT = _Illumination()
