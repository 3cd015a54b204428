"""What makes a person's hand other than the hand model: the table `subject.anatomy` of a scene."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

from msgspec import Meta

from hwp_bench.base.records import Seed, number

_Length = Annotated[float, Meta(ge=0.8, le=1.25)]
_Width = Annotated[float, Meta(ge=0.75, le=1.25)]
_Palm = Annotated[float, Meta(ge=0.85, le=1.2)]


@dataclass(frozen=True)
class SubjectAnatomy:
    """How a subject differs from every shape of the hand model; the default not at all.

    Spreads are standard deviations; what is drawn stays within two of them. Both hands of a
    person are the same, mirrored.
    """

    #: Seed of what is drawn; the subject's own where it is absent.
    seed: Seed | None = None
    #: Spread of the bones' lengths, percent; bones of the palm have half of it.
    bone_length: float = number(0.0, 0.0, 10.0)
    #: Spread of the segments' thickness, percent.
    thickness: float = number(0.0, 0.0, 15.0)
    #: Length of thumb, index, middle, ring and little finger, as a factor.
    finger_lengths: tuple[_Length, _Length, _Length, _Length, _Length] = (1.0,) * 5
    #: Thickness of the same.
    finger_widths: tuple[_Width, _Width, _Width, _Width, _Width] = (1.0,) * 5
    #: Length, width and depth of the palm, as factors.
    palm: tuple[_Palm, _Palm, _Palm] = (1.0, 1.0, 1.0)
    #: How far the centres about which fingers bend are moved, mm: each by a third to all of it,
    #: in any direction. Skinning weights stay.
    joint_shift: float = number(0.0, 0.0, 6.0)
    #: Skinning: 1 bends in narrow folds, -1 in wide ones, 0 as the hand model does.
    folds: float = number(0.0, -1.0, 1.0)
    #: How far nails stand out before the finger tips, mm.
    nail_length: float = number(0.0, 0.0, 8.0)
    #: Shape of their free edge, 0 (straight) to 1 (pointed).
    nail_taper: float = number(0.4, 0.0, 1.0)
    #: Thickening of the finger joints, mm.
    knuckles: float = number(0.0, 0.0, 2.5)
    #: Relief of bones and tendons on the back of the hand, mm.
    bony: float = number(0.0, 0.0, 1.5)
