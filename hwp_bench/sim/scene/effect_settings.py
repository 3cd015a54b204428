"""Settings of the four perturbations: what a scene's `[[effects]]` tables hold besides episodes."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

from hwp_bench.sim.props.objects import check_object
from hwp_bench.sim.scene.fields import Fields
from hwp_bench.sim.scene.gestures import gesture
from hwp_bench.sim.scene.schema import EffectCall, HandKey, Scene

#: What an episode of the illumination effect can do to the light.
LIGHT_MODES = ("dim", "bright", "warm", "cool", "move", "flicker", "shadow")
_ZERO = (0.0, 0.0, 0.0)


@dataclass(frozen=True)
class ComplexPoses:
    """Settings of `complex_poses`."""

    #: Keys per second.
    pace: float
    #: Keys of each side of the scene; a side without keys keeps its track.
    keys: Mapping[str, tuple[HandKey, ...]]


@dataclass(frozen=True)
class ObjectItem:
    """One object of a scene and how it moves."""

    #: Name of the object.
    object: str
    #: Its look.
    variant: int
    #: Hand that it moves with, or `world`.
    anchor: str
    #: m from the palm (or from the point looked at) at full strength.
    place: tuple[float, float, float]
    #: m from there at strength 0: where the object comes from.
    away: tuple[float, float, float]
    #: Degrees about x, y, z.
    rotate: tuple[float, float, float]
    #: Degrees per second about x, y, z.
    spin: tuple[float, float, float]
    #: m of swing along x, y, z, at `pace`.
    swing: tuple[float, float, float]
    #: Swings per second.
    pace: float
    #: Strength from which it is there.
    above: float


@dataclass(frozen=True)
class ObjectInteraction:
    """Settings of `hand_object_interaction`."""

    #: The objects, at least one.
    items: tuple[ObjectItem, ...]
    #: How a hand is held while it interacts, by side; others keep their track.
    staged: Mapping[str, HandKey]


@dataclass(frozen=True)
class MotionBlur:
    """Settings of `motion_blur`."""

    #: How long the shutter is open, s.
    shutter: float
    #: Way of the whole image, as a share of the hands' way.
    camera_share: float


def check_settings(scene: Scene, call: EffectCall, where: str) -> None:
    """Check the settings of an effect.

    Raises:
        BadInput: a setting is missing, unknown or out of range; it is named.
    """
    if call.kind == "complex_poses":
        complex_poses(call, scene.sides, where)
    elif call.kind == "hand_object_interaction":
        object_interaction(call, scene.sides, where)
    elif call.kind == "illumination":
        light_modes(call, where)
    else:
        motion_blur(call, where)


def complex_poses(call: EffectCall, sides: tuple[str, ...], where: str) -> ComplexPoses:
    """Read the settings of `complex_poses`."""
    fields = _fields(call, where)
    pace = fields.number("pace", 0.1, 10.0, default=1.6)
    keys = {side: tuple(hand_key(row) for row in fields.rows(side)) for side in sides}
    if not any(keys.values()):
        raise fields.wrong("right or left", "holds no key")
    fields.finish()
    return ComplexPoses(pace, keys)


def object_interaction(call: EffectCall, sides: tuple[str, ...], where: str) -> ObjectInteraction:
    """Read the settings of `hand_object_interaction`."""
    fields = _fields(call, where)
    items = tuple(_item(row, sides) for row in fields.rows("items"))
    if not items:
        raise fields.wrong("items", "names no object")
    staged = {}
    table = fields.optional_table("stage")
    if table is not None:
        for side in sides:
            key = table.optional_table(side)
            if key is not None:
                staged[side] = hand_key(key)
        table.finish()
    fields.finish()
    return ObjectInteraction(items, staged)


def light_modes(call: EffectCall, where: str) -> tuple[str, ...]:
    """Read the settings of `illumination`: what its episodes do to the light, in turn."""
    fields = _fields(call, where)
    modes = fields.rest().get("modes", ["dim", "warm", "move", "bright", "cool", "shadow"])
    unknown = set(call.settings) - {"modes"}
    if unknown:
        raise fields.wrong(sorted(unknown)[0], "is unknown")
    if not isinstance(modes, list) or not modes or not set(modes) <= set(LIGHT_MODES):
        raise fields.wrong("modes", f"is {modes!r}", remedy=f"Known: {', '.join(LIGHT_MODES)}.")
    return tuple(modes)


def motion_blur(call: EffectCall, where: str) -> MotionBlur:
    """Read the settings of `motion_blur`."""
    fields = _fields(call, where)
    blur = MotionBlur(
        shutter=fields.number("shutter", 0.001, 0.5, default=0.02),
        camera_share=fields.number("camera_share", 0.0, 1.0, default=0.0),
    )
    fields.finish()
    return blur


def hand_key(fields: Fields) -> HandKey:
    """Read one hand key, of a track or of an effect that stages the hands."""
    name = fields.text("gesture")
    gesture(name, where=fields.where, field=fields.name("gesture"))
    key = HandKey(
        gesture=name,
        place=fields.vector("place", 1.0, default=_ZERO),
        turn=fields.number("turn", -360.0, 360.0, default=0.0),
        tilt=fields.number("tilt", -90.0, 90.0, default=0.0),
        roll=fields.number("roll", -180.0, 180.0, default=0.0),
    )
    fields.finish()
    return key


def _fields(call: EffectCall, where: str) -> Fields:
    return Fields(call.settings, where, f"effects({call.kind}).")


def _item(row: Fields, sides: tuple[str, ...]) -> ObjectItem:
    name = row.text("object")
    check_object(name, row.where, row.name("object"))
    item = ObjectItem(
        object=name,
        variant=row.whole("variant", 0, 1000, default=0),
        anchor=row.choice("anchor", (*sides, "world"), default=sides[0]),
        place=row.vector("place", 1.0, default=_ZERO),
        away=row.vector("away", 2.0, default=_ZERO),
        rotate=row.vector("rotate", 360.0, default=_ZERO),
        spin=row.vector("spin", 3600.0, default=_ZERO),
        swing=row.vector("swing", 0.5, default=_ZERO),
        pace=row.number("pace", 0.0, 20.0, default=0.5),
        above=row.number("above", 0.0, 1.0, default=0.0),
    )
    row.finish()
    return item
