"""The four perturbations: settings, what each changes in a frame's recipe, and that recipe.

An effect is a set of hooks, each of which changes one part of the recipe. Effects compose in the
order of `ORDER`: pose, objects, light, shutter. A hook is only asked in frames where its effect
acts, so that every other frame is the same with and without it.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from types import MappingProxyType
from typing import Annotated, Any, ClassVar, Literal, TypeVar

import numpy as np
from msgspec import Meta

from hwp_bench.base.colors import lamp_color
from hwp_bench.base.errors import BadInput, UsageError
from hwp_bench.base.records import number, parse_record
from hwp_bench.sim.geometry.noise import generator
from hwp_bench.sim.geometry.surface import unit
from hwp_bench.sim.light.lights import CastShadow, Lights, focus_point, steady_light
from hwp_bench.sim.props.objects import check_object
from hwp_bench.sim.scene.motion import (
    HandMoment,
    along_keys,
    envelope,
    intrinsics,
    level,
    moment_of_key,
    moments,
    severity,
    track_moment,
)
from hwp_bench.sim.scene.scene import EffectCall, Episode, HandKey, Scene, by_side
from hwp_bench.sim.sensor import sensor_passes
from hwp_bench.sim.subject.subject import Words

_Metres = Annotated[float, Meta(ge=-1.0, le=1.0)]
_FarMetres = Annotated[float, Meta(ge=-2.0, le=2.0)]
_Swing = Annotated[float, Meta(ge=-0.5, le=0.5)]
_Degrees = Annotated[float, Meta(ge=-360.0, le=360.0)]
_Spin = Annotated[float, Meta(ge=-3600.0, le=3600.0)]
_LightMode = Literal["dim", "bright", "warm", "cool", "move", "flicker", "shadow"]
_ZERO = (0.0, 0.0, 0.0)

Settings = TypeVar("Settings")


@dataclass(frozen=True, eq=False)
class Placement:
    """An object in a frame."""

    #: Name and variant of the object.
    name: str
    variant: int
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
    """Base of every effect: hooks that do nothing."""

    #: Name in scenes and captures.
    name: ClassVar[str]
    #: The fields of its `effects` table after its episodes.
    settings: ClassVar[type]
    #: Names of the passes that a frame needs because the effect acts in it.
    passes: ClassVar[tuple[str, ...]] = ()
    #: Strengths for severity 1 to 5 where the scene has no calibration.
    default_strengths: ClassVar[tuple[float, float, float, float, float]]
    #: Largest strength that makes sense.
    max_strength: ClassVar[float]
    #: How far off an estimator is at strength 1: standard deviations in rad and m.
    estimate_errors: ClassVar[tuple[float, float]] = (0.0, 0.0)

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

    def estimate_error(self, strength: float) -> tuple[float, float]:
        """How far off an estimator is: standard deviations in rad and m."""
        angle, length = self.estimate_errors
        return angle * strength, length * strength


def read_settings(kind: type[Settings], call: EffectCall, where: str) -> Settings:
    """The settings of an effect as the dataclass of its kind."""
    return parse_record(kind, call.settings, where=where, field=_path(call), error=BadInput)


def check_settings(call: EffectCall, sides: tuple[str, ...], where: str) -> None:
    """Refuse settings of an effect that are at fault, or that name a hand the scene lacks."""
    settings: Any = read_settings(registered(call.kind).settings, call, where)
    path = _path(call)
    if isinstance(settings, ComplexPoses):
        check_sides(by_side(settings), sides, path, where)
    elif isinstance(settings, ObjectInteraction):
        check_sides(by_side(settings.stage), sides, f"{path}.stage", where)
        for index, item in enumerate(settings.items):
            if item.anchor not in (*sides, "world", None):
                raise BadInput(
                    f"is {item.anchor!r}",
                    where=where,
                    field=f"{path}.items[{index}].anchor",
                    remedy=f"Known: {', '.join((*sides, 'world'))}.",
                )


def check_sides(found: Mapping[str, Any], sides: tuple[str, ...], path: str, where: str) -> None:
    """Refuse a table with an entry for a hand that the scene does not show."""
    for side in found:
        if side not in sides:
            raise BadInput(
                f"the scene does not show the {side} hand", where=where, field=f"{path}.{side}"
            )


def _path(call: EffectCall) -> str:
    return f"effects({call.kind})"


# Complex poses: fast articulation and extreme angles, where an estimator errs more.


@dataclass(frozen=True)
class ComplexPoses:
    """Settings of `complex_poses`; a side without keys keeps its track."""

    #: Keys per second.
    pace: float = number(1.6, 0.1, 10.0)
    #: Keys of the right hand.
    right: tuple[HandKey, ...] | None = None
    #: Keys of the left hand.
    left: tuple[HandKey, ...] | None = None

    def __post_init__(self) -> None:
        if not self.right and not self.left:
            raise UsageError("holds no key", field="right or left")


class _ComplexPoses(Effect):
    name = "complex_poses"
    settings = ComplexPoses
    #: Error of the estimated joint angles, rad.
    default_strengths = (0.02, 0.035, 0.055, 0.085, 0.13)
    max_strength = 0.2
    estimate_errors = (1.0, 0.04)

    def stage(
        self, scene: Scene, call: EffectCall, seconds: float, hands: dict[str, HandMoment]
    ) -> dict[str, HandMoment]:
        settings = read_settings(ComplexPoses, call, scene.id)
        weight = envelope(call, seconds / scene.duration)
        changed = dict(hands)
        for side, rows in by_side(settings).items():
            if rows:
                row = [moment_of_key(key) for key in rows]
                label = f"complex-{side}"
                goal = along_keys(row, seconds * settings.pace, scene, label, 8.0)
                changed[side] = hands[side].blend(goal, weight)
        return changed


# Hand-object interaction: objects that the hands hold, touch or pass, that cover and shade them.


@dataclass(frozen=True)
class ObjectItem:
    """One object of a scene and how it moves."""

    #: Name of the object.
    object: Words
    #: Its variant.
    variant: int = number(0, 0, 1000)
    #: Hand that it moves with, or `world`; the scene's first hand if None.
    anchor: Literal["right", "left", "world"] | None = None
    #: m from the palm (or from the point looked at) at full strength.
    place: tuple[_Metres, _Metres, _Metres] = _ZERO
    #: m from there at strength 0: where the object comes from.
    away: tuple[_FarMetres, _FarMetres, _FarMetres] = _ZERO
    #: Degrees about x, y, z.
    rotate: tuple[_Degrees, _Degrees, _Degrees] = _ZERO
    #: Degrees per second about x, y, z.
    spin: tuple[_Spin, _Spin, _Spin] = _ZERO
    #: m of swing along x, y, z, at `pace`.
    swing: tuple[_Swing, _Swing, _Swing] = _ZERO
    #: Swings per second.
    pace: float = number(0.5, 0.0, 20.0)
    #: Strength from which it is there.
    above: float = number(0.0, 0.0, 1.0)

    def __post_init__(self) -> None:
        check_object(self.object)


@dataclass(frozen=True)
class StagedHands:
    """How hands are held while they interact; a hand without a key keeps its track."""

    #: The right hand.
    right: HandKey | None = None
    #: The left hand.
    left: HandKey | None = None


@dataclass(frozen=True)
class ObjectInteraction:
    """Settings of `hand_object_interaction`."""

    #: The objects, at least one.
    items: tuple[ObjectItem, ...] = ()
    #: How the hands are held.
    stage: StagedHands = field(default_factory=StagedHands)

    def __post_init__(self) -> None:
        if not self.items:
            raise UsageError("names no object", field="items")


class _HandObjectInteraction(Effect):
    name = "hand_object_interaction"
    settings = ObjectInteraction
    passes = ("objects",)
    #: 0 leaves the objects where they come from, 1 brings them to their place.
    default_strengths = (0.25, 0.45, 0.65, 0.85, 1.0)
    max_strength = 1.0
    estimate_errors = (0.06, 0.003)

    def stage(
        self, scene: Scene, call: EffectCall, seconds: float, hands: dict[str, HandMoment]
    ) -> dict[str, HandMoment]:
        settings = read_settings(ObjectInteraction, call, scene.id)
        weight = envelope(call, seconds / scene.duration)
        changed = dict(hands)
        for side, key in by_side(settings.stage).items():
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
            placements.append(Placement(item.object, item.variant, anchor, transform))
        return tuple(placements)


# Illumination: exposure, colour temperature, direction of the lamps, flicker, a passing shadow.


@dataclass(frozen=True)
class Illumination:
    """Settings of `illumination`."""

    #: What the episodes do to the light, in turn.
    modes: tuple[_LightMode, ...] = ("dim", "warm", "move", "bright", "cool", "shadow")

    def __post_init__(self) -> None:
        if not self.modes:
            raise UsageError("is empty", field="modes")


class _Illumination(Effect):
    name = "illumination"
    settings = Illumination
    passes = ("light",)
    #: 1 halves or doubles the exposure, or its equal in colour or direction.
    default_strengths = (0.15, 0.3, 0.5, 0.8, 1.2)
    max_strength = 2.5
    estimate_errors = (0.004, 0.0005)

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


# Motion blur: hands or camera that move while the shutter is open.


@dataclass(frozen=True)
class MotionBlur:
    """Settings of `motion_blur`."""

    #: How long the shutter is open, s.
    shutter: float = number(0.02, 0.001, 0.5)
    #: Way of the whole image, as a share of the hands' way.
    camera_share: float = number(0.0, 0.0, 1.0)


class _MotionBlur(Effect):
    name = "motion_blur"
    settings = MotionBlur
    passes = ("shutter",)
    #: Length of the streak, fraction of the image's width.
    default_strengths = (0.008, 0.018, 0.034, 0.06, 0.1)
    max_strength = 0.25
    estimate_errors = (0.5, 0.04)

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


def _slow_angle(scene: Scene, seconds: float) -> float:
    """Direction of the shaking, which turns a few times a second."""
    rates = generator(scene.seed, "shake").uniform(1.0, 3.0, 2)
    return float(np.pi * np.sin(rates[0] * seconds) + 2.0 * np.sin(rates[1] * seconds + 1.0))


#: The effects by name, in the order in which they act on a frame.
EFFECTS: Mapping[str, Effect] = MappingProxyType(
    {
        effect.name: effect
        for effect in (_ComplexPoses(), _HandObjectInteraction(), _Illumination(), _MotionBlur())
    }
)
ORDER = tuple(EFFECTS)


def registered(kind: str) -> Effect:
    """Return the effect of a name."""
    if kind not in EFFECTS:
        raise BadInput(f"there is no effect {kind!r}", remedy=f"Known: {', '.join(ORDER)}.")
    return EFFECTS[kind]


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


def plan_frame(
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
