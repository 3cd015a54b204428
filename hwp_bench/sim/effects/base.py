"""The base of every effect, and the effects by name: four perturbations and the sensor.

An effect is a set of hooks, each of which changes one part of a frame's recipe. Effects compose
in a stated order: first the perturbations in the order of `ORDER` (pose, objects, light,
shutter), last the `SENSOR`. The sensor is not a perturbation: it has no episodes and no severity,
and every frame and its clean version pass it alike.
"""

from __future__ import annotations

import importlib
from dataclasses import dataclass, field
from functools import cache

import numpy as np

from hwp_bench.base.errors import BadInput
from hwp_bench.sim.props.objects import ObjectRequest
from hwp_bench.sim.scene.motion import HandMoment
from hwp_bench.sim.scene.optics import Lights
from hwp_bench.sim.scene.schema import EffectCall, Scene

#: Order in which the perturbations act on a frame.
ORDER = ("complex_poses", "hand_object_interaction", "illumination", "motion_blur")
#: The effect that follows them in every frame.
SENSOR = "sensor"


@cache
def registered(kind: str) -> Effect:
    """Return the effect of a name; its module is imported on the first request.

    Raises:
        BadInput: no effect has that name.
    """
    known = (*ORDER, SENSOR)
    if kind not in known:
        raise BadInput(f"there is no effect {kind!r}", remedy=f"Known: {', '.join(known)}.")
    effect: Effect = importlib.import_module(f"hwp_bench.sim.effects.{kind}").EFFECT
    return effect


@dataclass(frozen=True, eq=False)
class Placement:
    """An object in a frame."""

    #: Which object.
    request: ObjectRequest
    #: Hand that it moves with, or `world`.
    anchor: str
    #: (4, 4) from the object to its anchor: the hand as it is at zero heading, origin in the
    #: palm, camera axes; or the world relative to the point looked at.
    transform: np.ndarray = field(repr=False)


@dataclass(frozen=True)
class Shutter:
    """How hands and image move while the shutter is open."""

    #: How long it is open, s.
    seconds: float
    #: Way of the hands across the image in that time, fraction of the image's width.
    hand: tuple[float, float]
    #: Way of the whole image, likewise.
    camera: tuple[float, float]
    #: Turn of the hands about the viewing axis, degrees.
    twist: float


class Effect:
    """Base of every effect: hooks that do nothing.

    A hook is only asked in frames where the effect acts, so that every other frame is the same
    with and without it.
    """

    #: Name in scenes and captures.
    name: str
    #: Strengths for severity 1 to 5 where the scene has no calibration; perturbations only.
    default_strengths: tuple[float, float, float, float, float]
    #: Largest strength that makes sense; perturbations only.
    max_strength: float

    def passes(self, scene: Scene) -> tuple[str, ...]:
        """Names of the passes that a frame needs because the effect acts in it."""
        return ()

    def stage(
        self, scene: Scene, call: EffectCall, seconds: float, hands: dict[str, HandMoment]
    ) -> dict[str, HandMoment]:
        """Change what the hands do."""
        return hands

    def objects(
        self, scene: Scene, call: EffectCall, seconds: float, strength: float
    ) -> tuple[Placement, ...]:
        """Bring objects into the frame."""
        return ()

    def light(
        self, scene: Scene, call: EffectCall, seconds: float, strength: float, lights: Lights
    ) -> Lights:
        """Change the light or the exposure."""
        return lights

    def shutter(
        self, scene: Scene, call: EffectCall, seconds: float, strength: float
    ) -> Shutter | None:
        """Open the shutter long enough to see motion."""
        return None

    def readout(self, scene: Scene) -> float:
        """How long the sensor takes from its first row to its last, s; 0 reads all at once."""
        return 0.0

    def record(
        self, scene: Scene, frame: int, colors: tuple[np.ndarray, ...]
    ) -> tuple[np.ndarray, ...]:
        """Change the light that is counted: (S, S, 3) linear, of a frame and its clean version."""
        return colors

    def store(self, scene: Scene, image: np.ndarray) -> np.ndarray:
        """Change the image that is stored: (S, S, 3) uint8 sRGB."""
        return image

    def estimate_error(self, strength: float) -> tuple[float, float]:
        """How far off an estimator is: standard deviations in rad and m."""
        return 0.0, 0.0
