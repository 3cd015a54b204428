"""How a subject looks beyond tone and age: marks on the skin, and what the person wears.

Everything here belongs to the person: it stays through the capture, in the clean versions too.
Rings, polish, tattoos and gloves cannot be taken off the hand's picture, so they count as hand in
masks. Watch, bracelet, sleeve and forearm do not.
"""

from __future__ import annotations

from dataclasses import asdict, dataclass, replace
from typing import Annotated, Any, Literal

from msgspec import Meta

from hwp_bench.base.errors import UsageError
from hwp_bench.base.records import Seed, number

_Channel = Annotated[float, Meta(ge=0.0, le=1.0)]
#: An sRGB colour, 0-1 each.
Color = tuple[_Channel, _Channel, _Channel]
#: The hands that wear something.
Wearing = Literal["both", "right", "left"]
#: A finger.
Finger = Literal["thumb", "index", "middle", "ring", "little"]


@dataclass(frozen=True)
class Tattoo:
    """A drawing under the skin."""

    #: What is drawn; the seed varies it.
    motif: Literal["mandala", "vine", "polygons", "bands", "letters"]
    #: Where: the back of the hand, or the backs of the fingers.
    place: Literal["back", "fingers"] = "back"
    #: Which drawing of its kind.
    seed: Seed = 0
    #: Size relative to the place.
    size: float = number(1.0, 0.3, 2.0)
    #: sRGB of the ink.
    ink: Color = (0.10, 0.14, 0.18)
    #: The hands that have it.
    side: Wearing = "both"


@dataclass(frozen=True)
class Polish:
    """Nail polish."""

    #: sRGB: one for all nails, or five from the thumb to the little finger.
    colors: tuple[Color, ...]
    #: 0 (matt) to 1 (wet).
    gloss: float = number(0.8, 0.0, 1.0)
    #: The hands that wear it.
    side: Wearing = "both"

    def __post_init__(self) -> None:
        if len(self.colors) not in (1, 5):
            raise UsageError(
                f"holds {len(self.colors)} colours", field="colors", remedy="Give one or five."
            )


@dataclass(frozen=True)
class Ring:
    """A ring around the first bone of a finger."""

    #: Which finger.
    finger: Finger
    #: What it is made of.
    metal: Literal["gold", "silver", "steel", "black"] = "gold"
    #: Width along the finger, m.
    width: float = number(0.004, 0.0015, 0.012)
    #: Diameter of a stone on the back, m; 0 for none.
    stone: float = number(0.0, 0.0, 0.012)
    #: sRGB of the stone.
    stone_color: Color = (0.75, 0.85, 0.95)
    #: The hand that wears it.
    side: Wearing = "both"


@dataclass(frozen=True)
class WristWear:
    """A watch or a bracelet; it does not count as hand."""

    #: A watch on a strap, a smooth bangle, or a string of beads.
    kind: Literal["watch", "bangle", "beads"]
    #: sRGB of strap, bangle or beads.
    color: Color = (0.32, 0.18, 0.10)
    #: The hand that wears it.
    side: Wearing = "left"


@dataclass(frozen=True)
class Glove:
    """A glove; covered skin shows nothing of itself."""

    #: Over the whole hand, or open from the middle of the first finger bones.
    kind: Literal["work", "fingerless"]
    #: sRGB of the cloth.
    color: Color = (0.42, 0.40, 0.36)
    #: sRGB of the grip on the palm side.
    palm: Color = (0.30, 0.24, 0.18)
    #: How far it lifts the surface, m.
    thickness: float = number(0.0012, 0.0002, 0.003)
    #: Which glove of its kind: weave and stains.
    seed: Seed = 0
    #: The hands that wear it.
    side: Wearing = "both"


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
                raise UsageError("a hand wears two", field=name)

    def on(self, side: str) -> Looks:
        """The looks of one hand: what the other one wears is left out.

        Hands that look alike give equal looks, so that they share one painting.
        """

        def worn(items: tuple[Any, ...]) -> tuple[Any, ...]:
            return tuple(
                replace(item, side="both") for item in items if item.side in (side, "both")
            )

        return replace(
            self,
            tattoos=worn(self.tattoos),
            polish=worn(self.polish),
            rings=worn(self.rings),
            wrist=worn(self.wrist),
            gloves=worn(self.gloves),
        )

    def to_json(self) -> dict[str, Any]:
        """Return what differs from the defaults, as JSON values."""
        plain = asdict(PLAIN)
        return {name: value for name, value in asdict(self).items() if value != plain[name]}

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
