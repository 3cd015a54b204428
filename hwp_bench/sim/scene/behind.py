"""People and things that move behind the hands, in front of the backdrop.

Places are in halves of the picture: x from -1 (left) to 1 (right), y from -1 (top) to 1 (bottom).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, Literal

from msgspec import Meta

from hwp_bench.base.records import Seed, number

_Tone = Annotated[float, Meta(ge=-0.4, le=1.4)]
_Place = Annotated[float, Meta(ge=-2.0, le=2.0)]


@dataclass(frozen=True)
class Clutter:
    """Objects that drift past, a third of them in colours of skin."""

    #: How many.
    count: int = number(8, 1, 60)
    #: Speed, halves of the picture a second.
    speed: float = number(0.25, 0.0, 3.0)
    #: Which ones, and where they start.
    seed: Seed = 0


@dataclass(frozen=True)
class Face:
    """A face out of focus that looks around and blinks."""

    #: Skin tone as the subject has one; the subject's if None.
    tone: _Tone | None = None
    #: Which face: proportions, hair, clothes.
    seed: Seed = 0
    #: Where its middle is.
    place: tuple[_Place, _Place] = (0.25, -0.25)
    #: Half of the head's height.
    size: float = number(0.75, 0.1, 3.0)
    #: How far it moves, of its size.
    sway: float = number(0.12, 0.0, 1.0)


@dataclass(frozen=True)
class OtherArm:
    """A forearm with a closed hand that reaches into the picture and back."""

    #: Skin tone as the subject has one; the subject's if None.
    tone: _Tone | None = None
    #: The border that it comes from.
    side: Literal["left", "right"] = "left"
    #: How far it reaches in, in the mean.
    reach: float = number(0.9, 0.0, 2.0)
    #: How far it moves.
    sway: float = number(0.35, 0.0, 1.0)
    #: Rounds of its motion a second.
    pace: float = number(0.22, 0.0, 3.0)
    #: Phase and marks.
    seed: Seed = 0


@dataclass(frozen=True)
class Behind:
    """The table `behind`; the defaults show nothing."""

    #: Things that drift past.
    clutter: Clutter | None = None
    #: Somebody's face.
    face: Face | None = None
    #: Another arm of the person.
    arm: OtherArm | None = None

    @property
    def passes(self) -> tuple[str, ...]:
        """Names of the passes that every frame needs because of what is behind."""
        there = {"clutter": self.clutter, "face": self.face, "other_arm": self.arm}
        return tuple(name for name, what in there.items() if what is not None)


#: Behind the hands there is the backdrop alone.
NOTHING = Behind()
