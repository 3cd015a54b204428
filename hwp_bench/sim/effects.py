"""The four perturbations: settings, what each changes in a frame's recipe, and that recipe.

An effect is its settings and hooks, each of which changes one part of the recipe. Effects compose
in the order of `ORDER`: pose, objects, light, shutter. A hook is only asked in frames where its
effect acts, so that every other frame is the same with and without it.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, field, replace
from types import MappingProxyType
from typing import Annotated, ClassVar, Literal

import numpy as np
from msgspec import Meta

from hwp_bench.base.colors import lamp_color
from hwp_bench.base.errors import BadInput, UsageError
from hwp_bench.base.records import number, parse_record
from hwp_bench.capture.splits import contiguous_split
from hwp_bench.sim.geometry.noise import generator
from hwp_bench.sim.geometry.surface import rigid, unit
from hwp_bench.sim.light.lights import CastShadow, Lights, steady_light
from hwp_bench.sim.props.objects import check_object
from hwp_bench.sim.scene.scene import (
    CLEAN_FROM,
    EffectCall,
    Episode,
    HandKey,
    HandMoment,
    Scene,
    along_keys,
    by_side,
    envelope,
    intrinsics,
    level,
    moment_of_key,
    moments,
    severity,
    track_moment,
)
from hwp_bench.sim.sensor import sensor_passes
from hwp_bench.sim.subject.subject import Words

_Metres = Annotated[float, Meta(ge=-1.0, le=1.0)]
_FarMetres = Annotated[float, Meta(ge=-2.0, le=2.0)]
_Swing = Annotated[float, Meta(ge=-0.5, le=0.5)]
_Degrees = Annotated[float, Meta(ge=-360.0, le=360.0)]
_Spin = Annotated[float, Meta(ge=-3600.0, le=3600.0)]
_LightMode = Literal["dim", "bright", "warm", "cool", "move", "flicker", "shadow"]
_ZERO = (0.0, 0.0, 0.0)


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
    """How hands and camera move while the shutter is open."""

    #: How long it is open, s.
    seconds: float
    #: Way of the hands across the image in that time, fraction of the image's width.
    hand: tuple[float, float]
    #: Way that a shift of the camera adds to hands and objects, likewise; the backdrop is far away
    #: and stays.
    camera: tuple[float, float]
    #: Turn of the hands about the viewing axis, degrees.
    twist: float


class Effect:
    """An effect: its fields are the settings of its `effects` table, its hooks do nothing."""

    #: Name in scenes and captures.
    name: ClassVar[str]
    #: Names of the passes that a frame needs because the effect acts in it.
    passes: ClassVar[tuple[str, ...]] = ()
    #: Strengths for severity 1 to 5 where the scene has no calibration.
    default_strengths: ClassVar[tuple[float, float, float, float, float]]
    #: Largest strength that makes sense.
    max_strength: ClassVar[float]
    #: How far off an estimator is at strength 1: standard deviations in rad and m.
    estimate_errors: ClassVar[tuple[float, float]]

    def named_hands(self) -> Iterator[tuple[str, str]]:
        """The hands that the settings name, each with the field that does."""
        return iter(())

    def pose_hands(
        self, scene: Scene, call: EffectCall, seconds: float, hands: dict[str, HandMoment]
    ) -> dict[str, HandMoment]:
        """Change what the hands do."""
        return hands

    def place_objects(
        self, scene: Scene, seconds: float, strength: float, moved: float
    ) -> list[Placement]:
        """Bring those objects that are there at `strength` to their places at strength `moved`."""
        return []

    def change_light(
        self, scene: Scene, call: EffectCall, seconds: float, strength: float, lights: Lights
    ) -> Lights:
        """Change the light or the exposure."""
        return lights

    def open_shutter(self, scene: Scene, seconds: float, strength: float) -> Shutter | None:
        """Open the shutter long enough to see motion."""
        return None

    @classmethod
    def estimate_error(cls, strength: float) -> tuple[float, float]:
        """How far off an estimator is: standard deviations in rad and m."""
        angle, length = cls.estimate_errors
        return angle * strength, length * strength


@dataclass(frozen=True)
class ComplexPoses(Effect):
    """Fast articulation and extreme angles, where an estimator errs more.

    A side without keys keeps its track. Strength is the error of the estimated joint angles, rad.
    """

    name = "complex_poses"
    default_strengths = (0.02, 0.035, 0.055, 0.085, 0.13)
    max_strength = 0.2
    estimate_errors = (1.0, 0.04)

    #: Keys per second.
    pace: float = number(1.6, 0.1, 10.0)
    #: Keys of the right hand.
    right: tuple[HandKey, ...] | None = None
    #: Keys of the left hand.
    left: tuple[HandKey, ...] | None = None

    def __post_init__(self) -> None:
        if not self.right and not self.left:
            raise UsageError("holds no key", field="right or left")

    def named_hands(self) -> Iterator[tuple[str, str]]:
        """The hands with keys, or that objects move with."""
        return ((side, side) for side in by_side(self))

    def pose_hands(
        self, scene: Scene, call: EffectCall, seconds: float, hands: dict[str, HandMoment]
    ) -> dict[str, HandMoment]:
        """Blend from the track to the keys."""
        weight = envelope(call, seconds / scene.duration)
        changed = dict(hands)
        for side, rows in by_side(self).items():
            if rows:
                row = [moment_of_key(key) for key in rows]
                goal = along_keys(row, seconds * self.pace, scene, f"complex-{side}", 8.0)
                changed[side] = hands[side].blend(goal, weight)
        return changed


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

    def transform(self, seconds: float, strength: float) -> np.ndarray:
        """(4, 4) from the object to its anchor at a time."""
        from scipy.spatial.transform import Rotation

        wave = np.sin(2.0 * np.pi * self.pace * seconds + np.array([0.0, 0.6, 1.2]))
        angles = np.array(self.rotate) + np.array(self.spin) * seconds
        turn = Rotation.from_euler("xyz", angles, degrees=True).as_matrix()
        away = (1.0 - strength) * np.array(self.away)
        # Objects keep their front: +z of an object faces the camera, its top is up.
        return rigid(
            turn @ np.diag([1.0, -1.0, -1.0]),
            np.array(self.place) + away + wave * np.array(self.swing),
        )


@dataclass(frozen=True)
class StagedHands:
    """How hands are held while they interact; a hand without a key keeps its track."""

    #: The right hand.
    right: HandKey | None = None
    #: The left hand.
    left: HandKey | None = None


@dataclass(frozen=True)
class ObjectInteraction(Effect):
    """Objects that the hands hold, touch or pass, that cover and shade them.

    Strength 0 leaves the objects where they come from, 1 brings them to their place.
    """

    name = "hand_object_interaction"
    passes = ("objects",)
    default_strengths = (0.25, 0.45, 0.65, 0.85, 1.0)
    max_strength = 1.0
    estimate_errors = (0.06, 0.003)

    #: The objects, at least one.
    items: tuple[ObjectItem, ...] = ()
    #: How the hands are held.
    stage: StagedHands = field(default_factory=StagedHands)

    def __post_init__(self) -> None:
        if not self.items:
            raise UsageError("names no object", field="items")

    def named_hands(self) -> Iterator[tuple[str, str]]:
        """The hands with keys, or that objects move with."""
        yield from ((f"stage.{side}", side) for side in by_side(self.stage))
        for index, item in enumerate(self.items):
            if item.anchor not in ("world", None):
                yield f"items[{index}].anchor", item.anchor

    def pose_hands(
        self, scene: Scene, call: EffectCall, seconds: float, hands: dict[str, HandMoment]
    ) -> dict[str, HandMoment]:
        """Blend from the track to the keys."""
        weight = envelope(call, seconds / scene.duration)
        changed = dict(hands)
        for side, key in by_side(self.stage).items():
            goal, track = moment_of_key(key), hands[side]
            # The wander of the track continues, so that a staged hand is not frozen.
            goal = HandMoment(
                goal.angles + 0.15 * (track.angles - goal.angles),
                goal.place + 0.1 * (track.place - goal.place),
                goal.heading + 0.06 * (track.heading - goal.heading),
            )
            changed[side] = track.blend(goal, weight)
        return changed

    def place_objects(
        self, scene: Scene, seconds: float, strength: float, moved: float
    ) -> list[Placement]:
        """Place the objects."""
        return [
            Placement(
                item.object,
                item.variant,
                item.anchor or scene.sides[0],
                item.transform(seconds, moved),
            )
            for item in self.items
            if strength >= item.above
        ]


@dataclass(frozen=True)
class Illumination(Effect):
    """Exposure, colour temperature, direction of the lamps, flicker, a passing shadow.

    Strength 1 halves the exposure or raises it by 62 %, or does its equal in colour or direction.
    `move` and `shadow` are of the key light and the lamps; sky and walls stay.
    """

    name = "illumination"
    passes = ("light",)
    default_strengths = (0.15, 0.3, 0.5, 0.8, 1.2)
    max_strength = 2.5
    estimate_errors = (0.004, 0.0005)

    #: What the episodes do to the light, in turn.
    modes: tuple[_LightMode, ...] = ("dim", "warm", "move", "bright", "cool", "shadow")

    def __post_init__(self) -> None:
        if not self.modes:
            raise UsageError("is empty", field="modes")

    def change_light(
        self, scene: Scene, call: EffectCall, seconds: float, strength: float, lights: Lights
    ) -> Lights:
        """Change the light as the mode of the episode says."""
        moment = seconds / scene.duration
        # The nearest: rounding may put the moment of an episode's end outside of it.
        away = [max(part.start - moment, moment - part.end, 0.0) for part in call.episodes]
        number = away.index(min(away))
        mode = self.modes[number % len(self.modes)]
        if mode in ("dim", "bright"):
            stops = -1.0 if mode == "dim" else 0.7
            return replace(lights, exposure=lights.exposure * 2.0 ** (stops * strength))
        if mode == "flicker":
            wave = np.sin(2.0 * np.pi * 3.1 * seconds) * np.sin(2.0 * np.pi * 1.3 * seconds + 1.0)
            return replace(lights, exposure=lights.exposure * 2.0 ** (strength * (wave - 0.4)))
        if mode in ("warm", "cool"):
            kelvin = 5500.0 * 2.0 ** ((-0.8 if mode == "warm" else 0.9) * strength)
            return lights.tinted(lamp_color(kelvin) / lamp_color(5500.0))
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
    lamps = tuple(lamp.turned(swing.as_matrix()) for lamp in lights.lamps)
    return replace(lights, direction=unit(direction), lamps=lamps)


@dataclass(frozen=True)
class MotionBlur(Effect):
    """Hands or camera that move while the shutter is open.

    Strength is the length of the streak, as a fraction of the image's width.
    """

    name = "motion_blur"
    passes = ("shutter",)
    default_strengths = (0.008, 0.018, 0.034, 0.06, 0.1)
    max_strength = 0.25
    estimate_errors = (0.5, 0.04)

    #: How long the shutter is open, s.
    shutter: float = number(0.02, 0.001, 0.5)
    #: Way that a shift of the camera adds to hands and objects, as a share of the hands' way; the
    #: backdrop is far away and stays.
    camera_share: float = number(0.0, 0.0, 1.0)

    def open_shutter(self, scene: Scene, seconds: float, strength: float) -> Shutter | None:
        """Shake hands and camera."""
        # The direction of the shaking turns a few times a second.
        rates = generator(scene.seed, "shake").uniform(1.0, 3.0, 2)
        angle = float(np.pi * np.sin(rates[0] * seconds) + 2.0 * np.sin(rates[1] * seconds + 1.0))
        shaken, share = 1.7 * angle + 1.0, self.camera_share * strength
        return Shutter(
            seconds=self.shutter,
            hand=(float(strength * np.cos(angle)), float(strength * np.sin(angle))),
            camera=(float(share * np.cos(shaken)), float(share * np.sin(shaken))),
            twist=150.0 * strength * float(np.sin(2.3 * angle)),
        )


#: The effects by name, in the order in which they act on a frame.
EFFECTS: Mapping[str, type[Effect]] = MappingProxyType(
    {effect.name: effect for effect in (ComplexPoses, ObjectInteraction, Illumination, MotionBlur)}
)
ORDER = tuple(EFFECTS)


def read_effect(call: EffectCall, where: str) -> Effect:
    """The effect of a call with its settings."""
    path = f"effects({call.kind})"
    return parse_record(EFFECTS[call.kind], call.settings, where=where, field=path, error=BadInput)


def check_hands(found: Iterable[tuple[str, str]], scene: Scene, path: str, where: str) -> None:
    """Refuse a field that names a hand which the scene does not show."""
    for name, side in found:
        if side not in scene.sides:
            raise BadInput(
                f"the scene does not show the {side} hand",
                where=where,
                field=f"{path}.{name}",
                remedy=f"It shows: {', '.join(scene.sides)}.",
            )


def check_modes(effect: Effect, call: EffectCall, scene: Scene, where: str) -> None:
    """Refuse modes of an illumination that do nothing to the light of the scene."""
    if not isinstance(effect, Illumination) or scene.light.key or scene.light.lamps:
        return
    for mode in ("move", "shadow"):
        if mode in effect.modes[: len(call.episodes)]:
            raise BadInput(
                f"{mode!r} changes the key light and lamps, and the scene has neither",
                where=where,
                field=f"effects({call.kind}).modes",
                remedy="Give the scene's light a key or lamps, or choose other modes.",
            )


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


def shown_in(scene: Scene, frame: int, frame_count: int) -> Scene:
    """The scene of a frame: without effects in the first validation frame.

    It comes before `CLEAN_FROM`, so that an episode may reach into it, where the number of frames
    is not a multiple of five.
    """
    first, _ = contiguous_split(scene.id, frame_count).validation_range
    early = frame == first and first / frame_count < CLEAN_FROM
    return replace(scene, effects=()) if early else scene


def plan_frame(
    scene: Scene,
    frame: int,
    frame_count: int,
    size: int,
    strengths: Mapping[str, float] | None = None,
) -> FramePlan:
    """Plan one frame."""
    absent = {call.kind: 0 for call in scene.effects}
    scene = shown_in(scene, frame, frame_count)
    moment = float(moments(frame_count)[frame])
    seconds = moment * scene.duration
    acting = {
        kind: (strengths or {}).get(kind, strength)
        for kind, strength in strengths_at(scene, moment).items()
    }
    shutter = None
    for call in scene.effects:
        if call.kind in acting:
            effect = read_effect(call, scene.id)
            shutter = effect.open_shutter(scene, seconds, acting[call.kind]) or shutter
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
    passes += [name for kind in ORDER if kind in acting for name in EFFECTS[kind].passes]
    passes += sensor_passes(scene.sensor)
    return FramePlan(
        frame=frame,
        seconds=seconds,
        severity=absent | {call.kind: severity(call, moment) for call in scene.effects},
        strength=acting,
        subframes=subframes,
        shutter=shutter,
        readout=scene.sensor.rolling_shutter,
        passes=tuple(passes),
    )


def strengths_at(scene: Scene, moment: float) -> dict[str, float]:
    """Strength of every effect that acts at a moment."""
    levels = ((call, level(call, moment)) for call in scene.effects)
    return {call.kind: _strength_at(call, found) for call, found in levels if found}


def hands_at(scene: Scene, seconds: float) -> dict[str, HandMoment]:
    """The hands at a time, with the effects on their pose."""
    hands = {side: track_moment(scene, side, seconds) for side in scene.sides}
    for kind in ORDER:
        call = scene.effect(kind)
        if call is not None and level(call, seconds / scene.duration):
            hands = read_effect(call, scene.id).pose_hands(scene, call, seconds, hands)
    return hands


def objects_at(
    scene: Scene, recipe: FramePlan, seconds: float, moved: Mapping[str, float] | None = None
) -> list[Placement]:
    """The objects of a frame at a time within its shutter; elsewhere with strengths `moved`."""
    return [
        placement
        for call, strength in _acting(scene, recipe)
        for placement in read_effect(call, scene.id).place_objects(
            scene, seconds, strength, (moved or {}).get(call.kind, strength)
        )
    ]


def lights_at(scene: Scene, recipe: FramePlan) -> Lights:
    """The light of a frame."""
    lights = steady_light(scene.light)
    for call, strength in _acting(scene, recipe):
        effect = read_effect(call, scene.id)
        lights = effect.change_light(scene, call, recipe.seconds, strength, lights)
    return lights


def _acting(scene: Scene, recipe: FramePlan) -> Iterator[tuple[EffectCall, float]]:
    """The effects that act in a frame, each with its strength."""
    calls = (call for call in scene.effects if call.kind in recipe.strength)
    return ((call, recipe.strength[call.kind]) for call in calls)


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
    """Strength at a level from 0 (absent) to 5, interpolated between severities."""
    strengths = call.strengths or EFFECTS[call.kind].default_strengths
    table = (0.0, *strengths)
    return float(np.interp(level, np.arange(len(table)), table))
