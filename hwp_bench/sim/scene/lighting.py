"""Settings of light besides the key light: lamps and windows of any size, and coloured walls."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

from msgspec import Meta

from hwp_bench.base.errors import UsageError
from hwp_bench.base.records import number

_Way = Annotated[float, Meta(ge=-10.0, le=10.0)]
_Channel = Annotated[float, Meta(ge=0.0, le=1.0)]
#: An sRGB colour.
Colour = tuple[_Channel, _Channel, _Channel]
#: Least distance of a lamp from the point that the camera looks at, m: hands must fit between.
NEAREST = 0.2


@dataclass(frozen=True)
class Lamp:
    """A lamp or a window: a rectangle of even light that faces the point looked at."""

    #: Its centre, m from the point that the camera looks at: x right, y down, z away.
    place: tuple[_Way, _Way, _Way]
    #: Irradiance at that point, of a surface that faces the lamp, relative to white.
    strength: Annotated[float, Meta(ge=0.0, le=20.0)]
    #: Horizontal edge, m; shadows are hard where it is small against the distance.
    width: float = number(0.1, 0.005, 5.0)
    #: The other edge, m; 0 is as wide as high.
    height: float = number(0.0, 0.0, 5.0)
    #: Colour temperature, kelvin.
    kelvin: float = number(5500.0, 1500.0, 15000.0)
    #: sRGB colour of a shade or pane in front of it.
    color: Colour = (1.0, 1.0, 1.0)
    #: Share of the light that passes through thin parts of a hand, of what passes through skin.
    through: float = number(0.0, 0.0, 1.0)

    def __post_init__(self) -> None:
        if sum(way * way for way in self.place) < NEAREST**2:
            raise UsageError(
                f"is nearer than {NEAREST} m to the point looked at",
                field="place",
                remedy="Hands are there; put the lamp farther away.",
            )


@dataclass(frozen=True)
class Room:
    """Six walls that send the sky's light back in their own colours, in place of the sky.

    Each is an sRGB colour; a white wall is as bright as the sky would be.
    """

    #: The wall left of the camera's view.
    left: Colour = (0.8, 0.8, 0.8)
    #: The wall right of it.
    right: Colour = (0.8, 0.8, 0.8)
    #: The ceiling.
    ceiling: Colour = (0.95, 0.95, 0.95)
    #: The floor or table.
    floor: Colour = (0.6, 0.55, 0.5)
    #: The wall behind the hands.
    far: Colour = (0.8, 0.8, 0.8)
    #: The wall behind the camera.
    near: Colour = (0.8, 0.8, 0.8)
