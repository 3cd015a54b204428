"""The person whose hands are shown, as checked data: tone, age, and looks beyond them.

Everything here belongs to the person: it stays through the capture, in the clean versions too.
Rings, polish, tattoos and gloves cannot be taken off the hand's picture, so they count as hand in
masks. Watch, bracelet, sleeve and forearm do not.
"""

from __future__ import annotations

from dataclasses import asdict, dataclass, fields, replace
from typing import Annotated, Any, Literal

from msgspec import Meta

from hwp_bench.base.errors import ODD_CHARACTERS, UsageError
from hwp_bench.base.records import Seed, number
from hwp_bench.sim.geometry.surface import Color
from hwp_bench.sim.hand.anatomy import SubjectAnatomy
from hwp_bench.sim.hand.rigs import rig_path
from hwp_bench.sim.subject.wear import Glove, Polish, Ring, Tattoo, WristWear


@dataclass(frozen=True)
class Looks:
    """The table `subject.looks`; the defaults change nothing."""

    #: Blood in the skin: -1 (pale) to 1 (flushed).
    blood: float = number(0.0, -1.0, 1.0)
    #: Yellow in the skin: -1 (pink) to 1 (olive).
    yellow: float = number(0.0, -1.0, 1.0)
    #: Freckles and age spots, 0 (those that age brings) to 1 (dense).
    freckles: float = number(0.0, 0.0, 1.0)
    #: Wrinkles beyond those of age, 0 to 1.
    wrinkles: float = number(0.0, 0.0, 1.0)
    #: Hair on the back of hand, fingers and forearm, 0 to 1.
    hair: float = number(0.0, 0.0, 1.0)
    #: sRGB of the hair.
    hair_color: Color = (0.16, 0.10, 0.07)
    #: What leads away from the wrist.
    arm: Literal["sleeve", "bare"] = "sleeve"
    #: Drawings under the skin.
    tattoos: tuple[Tattoo, ...] = ()
    #: Nail polish.
    polish: tuple[Polish, ...] = ()
    #: Rings.
    rings: tuple[Ring, ...] = ()
    #: Watch or bracelets.
    wrist: tuple[WristWear, ...] = ()
    #: Gloves, at most one for each hand.
    gloves: tuple[Glove, ...] = ()

    def __post_init__(self) -> None:
        for name in ("polish", "gloves", "wrist"):
            worn = [
                side
                for side in ("right", "left")
                for item in getattr(self, name)
                if item.side in (side, "both")
            ]
            if len(set(worn)) != len(worn):
                raise UsageError("has more than one for the same hand", field=name)

    def on(self, side: str) -> Looks:
        """The looks of one hand; hands that look alike give equal looks and share one painting."""
        worn: dict[str, Any] = {}
        for name in ("tattoos", "polish", "rings", "wrist", "gloves"):
            items = [item for item in getattr(self, name) if item.side in (side, "both")]
            worn[name] = tuple(replace(item, side="both") for item in items)
        return replace(self, **worn)

    @property
    def passes(self) -> tuple[str, ...]:
        """Names of the passes that every frame needs because of what is worn."""
        there = {
            "bare_arm": self.arm == "bare",
            "rings": bool(self.rings),
            "wrist_wear": bool(self.wrist),
        }
        return tuple(name for name, worn in there.items() if worn)


#: Looks that add nothing.
PLAIN = Looks()


#: A text with at least one visible character.
Words = Annotated[
    str,
    Meta(
        pattern=rf"\A[^{ODD_CHARACTERS}]*[^\s{ODD_CHARACTERS}][^{ODD_CHARACTERS}]*\Z",
        description="a text that is not empty",
    ),
]


@dataclass(frozen=True)
class Subject:
    """The person whose hands are shown."""

    #: Identity: shape parameters, surface detail, mottling.
    seed: Seed
    #: Skin tone, 0 (light) to 1 (dark); -0.4 is the palest skin and 1.4 the darkest.
    tone: Annotated[float, Meta(ge=-0.4, le=1.4)]
    #: Years; deepens creases, veins and tendons.
    age: Annotated[float, Meta(ge=5.0, le=100.0)]
    #: sRGB colour of the sleeve, 0-1 each.
    sleeve: Color = (0.25, 0.3, 0.4)
    #: Surface: `anny` (the free hand), `mano:PATH` or `mano-hd:PATH` where the user has it, or
    #: `gltf:PATH`, a rigged hand, or `rig:NAME`, one that comes with the package.
    model: Words = "anny"
    #: Marks on the skin and what the person wears.
    looks: Looks = PLAIN
    #: Geometry that no shape of the model has; None for the model as it is.
    anatomy: SubjectAnatomy | None = None

    def __post_init__(self) -> None:
        kind, _, path = self.model.partition(":")
        # A rig's name is checked where it is looked up.
        if rig_path(self.model) or self.model == "anny" or (path and kind in ("mano", "mano-hd")):
            return
        raise UsageError(
            f"is {self.model!r}",
            field="model",
            remedy="Use anny, mano:PATH, mano-hd:PATH, gltf:PATH or rig:NAME.",
        )


def without_defaults(record: Any, keep: tuple[str, ...] = ()) -> dict[str, Any]:
    """A record as JSON values, without fields that have their default."""
    said = [item for item in fields(record) if getattr(record, item.name) != item.default]
    wanted = {*keep, *(item.name for item in said)}
    return {name: value for name, value in asdict(record).items() if name in wanted}
