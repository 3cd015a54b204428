"""Settings of the four perturbations: the fields of an `effects` table after its episodes."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Annotated, Literal, Protocol, TypeVar

from msgspec import Meta

from hwp_bench.base.errors import BadInput, UsageError
from hwp_bench.base.records import number, parse_record
from hwp_bench.sim.props.objects import check_object
from hwp_bench.sim.scene.schema import EffectCall, HandKey, Words

_Metres = Annotated[float, Meta(ge=-1.0, le=1.0)]
_FarMetres = Annotated[float, Meta(ge=-2.0, le=2.0)]
_Swing = Annotated[float, Meta(ge=-0.5, le=0.5)]
_Degrees = Annotated[float, Meta(ge=-360.0, le=360.0)]
_Spin = Annotated[float, Meta(ge=-3600.0, le=3600.0)]
_LightMode = Literal["dim", "bright", "warm", "cool", "move", "flicker", "shadow"]
_ZERO = (0.0, 0.0, 0.0)

Settings = TypeVar("Settings")
Keys_co = TypeVar("Keys_co", covariant=True)
Keys = TypeVar("Keys")


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


@dataclass(frozen=True)
class Illumination:
    """Settings of `illumination`."""

    #: What the episodes do to the light, in turn.
    modes: tuple[_LightMode, ...] = ("dim", "warm", "move", "bright", "cool", "shadow")

    def __post_init__(self) -> None:
        if not self.modes:
            raise UsageError("is empty", field="modes")


@dataclass(frozen=True)
class MotionBlur:
    """Settings of `motion_blur`."""

    #: How long the shutter is open, s.
    shutter: float = number(0.02, 0.001, 0.5)
    #: Way of the whole image, as a share of the hands' way.
    camera_share: float = number(0.0, 0.0, 1.0)


_KINDS: Mapping[str, type] = {
    "complex_poses": ComplexPoses,
    "hand_object_interaction": ObjectInteraction,
    "illumination": Illumination,
    "motion_blur": MotionBlur,
}


class _BySide(Protocol[Keys_co]):
    """A table with one entry for each hand."""

    @property
    def right(self) -> Keys_co | None: ...

    @property
    def left(self) -> Keys_co | None: ...


def check_settings(call: EffectCall, sides: tuple[str, ...], where: str) -> None:
    """Check the settings of an effect.

    Args:
        call: the effect.
        sides: the hands of the scene.
        where: the file, for messages.

    Raises:
        BadInput: a setting is missing, unknown or out of range; it is named.
    """
    settings: object = read_settings(_KINDS[call.kind], call, where)
    path = _path(call)
    if isinstance(settings, ComplexPoses):
        keys_by_side(settings, sides, path, where)
    elif isinstance(settings, ObjectInteraction):
        keys_by_side(settings.stage, sides, f"{path}.stage", where)
        for index, item in enumerate(settings.items):
            if item.anchor not in (*sides, "world", None):
                raise BadInput(
                    f"is {item.anchor!r}",
                    where=where,
                    field=f"{path}.items[{index}].anchor",
                    remedy=f"Known: {', '.join((*sides, 'world'))}.",
                )


def read_settings(kind: type[Settings], call: EffectCall, where: str) -> Settings:
    """The settings of an effect as the dataclass of its kind; see `check_settings`."""
    return parse_record(kind, call.settings, where=where, field=_path(call), error=BadInput)


def keys_by_side(
    table: _BySide[Keys], sides: tuple[str, ...], path: str, where: str
) -> dict[str, Keys]:
    """The entries of a table for the hands of a scene, right first.

    Raises:
        BadInput: it has an entry for a hand that the scene does not show.
    """
    found = {
        side: keys
        for side, keys in (("right", table.right), ("left", table.left))
        if keys is not None
    }
    for side in found:
        if side not in sides:
            raise BadInput(
                f"the scene does not show the {side} hand", where=where, field=f"{path}.{side}"
            )
    return found


def _path(call: EffectCall) -> str:
    return f"effects({call.kind})"
