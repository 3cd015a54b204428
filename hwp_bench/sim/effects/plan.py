"""The plan of a frame: which passes, hands, objects and light the renderer needs for it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from hwp_bench.sim.camera.sensor import sensor_passes
from hwp_bench.sim.effects.effects import ORDER, Placement, Shutter, registered
from hwp_bench.sim.light.lights import Lights, steady_light
from hwp_bench.sim.scene.motion import (
    HandMoment,
    intrinsics,
    level,
    moments,
    severity,
    track_moment,
)
from hwp_bench.sim.scene.scene import EffectCall, Scene

#: Longest way between two sub-frames, in pixels.
SUBFRAME_STEP = 1.5
#: Most sub-frames of a frame.
MAX_SUBFRAMES = 24


@dataclass(frozen=True)
class FramePlan:
    """The recipe of one frame."""

    #: Number of the frame.
    frame: int
    #: Time of its middle, s.
    seconds: float
    #: Severity of every effect of the scene, 0-5.
    severity: Mapping[str, int]
    #: Strength of every effect that acts in this frame.
    strength: Mapping[str, float]
    #: Sub-frames: 1 without motion blur.
    subframes: int
    #: Motion while the shutter is open, or None.
    shutter: Shutter | None
    #: Time from the reading of the first row to that of the last, s.
    readout: float
    #: Passes in their order, by name.
    passes: tuple[str, ...]

    @property
    def perturbed(self) -> bool:
        """Whether the image differs from its clean version."""
        return any(name in self.passes for name in ("objects", "light", "shutter"))


def plan(
    scene: Scene,
    frame: int,
    frame_count: int,
    size: int,
    strengths: Mapping[str, float] | None = None,
) -> FramePlan:
    """Plan one frame."""
    moment = float(moments(frame_count)[frame])
    seconds = moment * scene.duration
    acting = {
        call.kind: (strengths or {}).get(call.kind, _strength_at(call, level(call, moment)))
        for call in scene.effects
        if level(call, moment)
    }
    shutter = None
    if "motion_blur" in acting:
        call = _call(scene, "motion_blur")
        shutter = registered("motion_blur").shutter(scene, call, seconds, acting["motion_blur"])
    subframes = 1
    if shutter is not None:
        way = _screen_way(scene, seconds, shutter, size)
        # In fours: each pixel then aims at every part of the lamp equally often.
        fours = np.ceil(way / SUBFRAME_STEP / 4.0)
        subframes = int(np.clip(4 * fours, 4, MAX_SUBFRAMES))
    passes = ["hands", "shadow", "sky", "backdrop"]
    passes += [*scene.subject.looks.passes, *scene.behind.passes]
    passes += ["lamps"] if scene.light.lamps else []
    passes += ["room"] if scene.light.room is not None else []
    for kind in ORDER:
        if kind in acting:
            passes += registered(kind).passes
    passes += sensor_passes(scene.sensor)
    return FramePlan(
        frame=frame,
        seconds=seconds,
        severity={call.kind: severity(call, moment) for call in scene.effects},
        strength=acting,
        subframes=subframes,
        shutter=shutter,
        readout=scene.sensor.rolling_shutter,
        passes=tuple(passes),
    )


def hands_at(scene: Scene, seconds: float) -> dict[str, HandMoment]:
    """The hands at a time, with the effects on their pose."""
    hands = {side: track_moment(scene, side, seconds) for side in scene.sides}
    moment = seconds / scene.duration
    for kind in ORDER:
        call = scene.effect(kind)
        if call is not None and level(call, moment):
            hands = registered(kind).stage(scene, call, seconds, hands)
    return hands


def objects_at(scene: Scene, recipe: FramePlan, seconds: float) -> tuple[Placement, ...]:
    """The objects of a frame at a time within its shutter."""
    placements: tuple[Placement, ...] = ()
    for kind, strength in recipe.strength.items():
        placements += registered(kind).objects(scene, _call(scene, kind), seconds, strength)
    return placements


def lights_at(scene: Scene, recipe: FramePlan) -> Lights:
    """The light of a frame."""
    lights = steady_light(scene.light)
    for kind, strength in recipe.strength.items():
        lights = registered(kind).light(scene, _call(scene, kind), recipe.seconds, strength, lights)
    return lights


def _call(scene: Scene, kind: str) -> EffectCall:
    call = scene.effect(kind)
    assert call is not None
    return call


def _screen_way(scene: Scene, seconds: float, shutter: Shutter, size: int) -> float:
    """Longest way of a hand across the image while the shutter is open, px."""
    half = shutter.seconds / 2.0
    before, after = hands_at(scene, seconds - half), hands_at(scene, seconds + half)
    focal = intrinsics(scene, size)[0, 0]
    way = 0.0
    for side in scene.sides:
        travel = np.linalg.norm(after[side].place - before[side].place)
        # Fingers are about 0.1 m away from the palm that the place names.
        turn = np.radians(np.abs(after[side].heading - before[side].heading).max())
        curl = np.radians(np.abs(after[side].angles - before[side].angles).max())
        way = max(way, travel + 0.1 * turn + 0.06 * curl)
    shake = np.hypot(*shutter.hand) + np.hypot(*shutter.camera)
    twist = 0.1 * np.radians(abs(shutter.twist))
    return float((way + twist) * focal / 0.5 + shake * size)


def _strength_at(call: EffectCall, level: float) -> float:
    """Strength at a level from 0 (absent) to 5, interpolated between severities.

    Strengths at severity 1 to 5 are the scene's own where it was calibrated
    (`hwp-bench sim calibrate`), else the effect's.
    """
    strengths = call.strengths or registered(call.kind).default_strengths
    table = (0.0, *strengths)
    return float(np.interp(level, np.arange(len(table)), table))
