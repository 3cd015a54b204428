"""The light of a scene: settings, and lamps, walls and shadows as the renderer needs them."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Annotated

import numpy as np
from msgspec import Meta

from hwp_bench.base.colors import lamp_color, srgb_to_linear
from hwp_bench.base.errors import UsageError
from hwp_bench.base.records import number
from hwp_bench.sim.geometry.surface import Color, unit

_Way = Annotated[float, Meta(ge=-10.0, le=10.0)]
_Axis = Annotated[float, Meta(ge=-100.0, le=100.0)]
_Brightness = Annotated[float, Meta(ge=0.0, le=20.0)]
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
    color: Color = (1.0, 1.0, 1.0)
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
    left: Color = (0.8, 0.8, 0.8)
    #: The wall right of it.
    right: Color = (0.8, 0.8, 0.8)
    #: The ceiling.
    ceiling: Color = (0.95, 0.95, 0.95)
    #: The floor or table.
    floor: Color = (0.6, 0.55, 0.5)
    #: The wall behind the hands.
    far: Color = (0.8, 0.8, 0.8)
    #: The wall behind the camera.
    near: Color = (0.8, 0.8, 0.8)


@dataclass(frozen=True)
class Light:
    """A key light and the sky, constant unless an effect changes them."""

    #: Direction towards the key light, world axes; need not be normalised.
    direction: tuple[_Axis, _Axis, _Axis]
    #: Irradiance of the key light relative to white.
    key: _Brightness
    #: Radiance of the sky relative to white.
    sky: _Brightness
    #: Colour temperature of the key light, kelvin.
    kelvin: Annotated[float, Meta(ge=1500.0, le=15000.0)]
    #: Lamps and windows besides it.
    lamps: Annotated[tuple[Lamp, ...], Meta(max_length=4)] = ()
    #: Coloured walls in place of the sky, or None.
    room: Room | None = None
    #: Factor on the light that falls on the backdrop.
    backdrop: float = number(1.0, 0.0, 50.0)

    def __post_init__(self) -> None:
        if not any(self.direction):
            raise UsageError("is zero", field="direction")


#: Distance of the backdrop behind the point looked at, m, for the light that falls on it.
BACKDROP_DISTANCE = 1.0
#: Share of a cube's face that a patch in its middle sees of the side it faces, and of each side
#: that borders it; the sixth lies behind. Source: view factor of a face from the middle of the
#: cube, (4 / pi) / sqrt(2) * atan(1 / sqrt(2)) = 0.5541, and a quarter of the rest.
FACING_SHARE = float(4.0 / np.pi / np.sqrt(2.0) * np.arctan(1.0 / np.sqrt(2.0)))
BORDER_SHARE = (1.0 - FACING_SHARE) / 4.0


@dataclass(frozen=True, eq=False)
class AreaLight:
    """A rectangle that shines evenly."""

    #: (3,) its centre, m, world.
    centre: np.ndarray
    #: (3,) from the centre to the middle of its right edge, m.
    across: np.ndarray
    #: (3,) from the centre to the middle of its lower edge, m.
    down: np.ndarray
    #: (3,) unit vector to the point looked at.
    facing: np.ndarray
    #: Distance of that point, m.
    distance: float
    #: (3,) irradiance there, of a surface that faces the light.
    irradiance: np.ndarray
    #: Share of the light that passes through skin.
    through: float = 0.0

    @property
    def slope(self) -> float:
        """Longer edge over the distance."""
        return float(2.0 * max(np.linalg.norm(self.across), np.linalg.norm(self.down))) / (
            self.distance
        )

    def turned(self, rotation: np.ndarray) -> AreaLight:
        """The light turned by a (3, 3) rotation about the point looked at."""
        focus = focus_point()
        return replace(
            self,
            centre=focus + rotation @ (self.centre - focus),
            across=rotation @ self.across,
            down=rotation @ self.down,
            facing=rotation @ self.facing,
        )

    def at(self, points: np.ndarray, normal: np.ndarray) -> np.ndarray:
        """Irradiance at (3,) points of a surface with a normal (3,), from the centre: (3,).

        0 at the centre itself, as behind the lamp.
        """
        way = self.centre - points
        squared = float(way @ way)
        if squared == 0.0:
            return np.zeros(3)
        cosine = float(way @ normal) / np.sqrt(squared)
        leaving = -float(way @ self.facing) / np.sqrt(squared)
        share = max(cosine, 0.0) * max(leaving, 0.0) * self.distance**2 / squared
        return np.asarray(share * self.irradiance)


def area_light(lamp: Lamp) -> AreaLight:
    """The light of a lamp."""
    place = np.array(lamp.place)
    facing = -unit(place)
    # As upright as it can be; a lamp straight above has its width from left to right.
    upright = np.array([0.0, 1.0, 0.0]) if abs(facing[1]) < 0.99 else np.array([0.0, 0.0, 1.0])
    across = unit(np.cross(upright, facing))
    down = np.cross(facing, across)
    height = lamp.height or lamp.width
    return AreaLight(
        centre=focus_point() + place,
        across=0.5 * lamp.width * across,
        down=0.5 * height * down,
        facing=facing,
        distance=float(np.linalg.norm(place)),
        irradiance=lamp.strength * lamp_color(lamp.kelvin) * srgb_to_linear(np.array(lamp.color)),
        through=lamp.through,
    )


def wall_radiance(room: Room, sky: float) -> np.ndarray:
    """Linear radiance of the walls in the directions +x, -x, +y, -y, +z, -z: (6, 3)."""
    walls = (room.right, room.left, room.floor, room.ceiling, room.far, room.near)
    return np.asarray(sky * srgb_to_linear(np.array(walls)))


def wall_irradiance(radiance: np.ndarray) -> np.ndarray:
    """Irradiance over pi in the middle of a cube of walls, for normals along the axes: (6, 3)."""
    behind = radiance.reshape(3, 2, 3)[:, ::-1].reshape(6, 3)
    borders = radiance.sum(axis=0) - radiance - behind
    return np.asarray(FACING_SHARE * radiance + BORDER_SHARE * borders)


#: Distance from the camera to the point that it looks at, m.
FOCUS_DISTANCE = 0.5


def focus_point() -> np.ndarray:
    """The point that places are relative to: (3,) m, world."""
    return np.array([0.0, 0.0, FOCUS_DISTANCE])


@dataclass(frozen=True, eq=False)
class CastShadow:
    """A soft-edged shadow over one side of the scene."""

    #: (3,) unit vector across the edge, into the shadow.
    across: np.ndarray
    #: Where the edge is along it, m.
    edge: float
    #: Width of the edge, m.
    width: float
    #: Share of the light of key light and lamps that is lost inside, 0-1.
    depth: float

    def passed(self, points: np.ndarray) -> np.ndarray:
        """Share of that light that passes at (N, 3) points: (N,)."""
        x = np.clip((points @ self.across - self.edge) / self.width + 0.5, 0.0, 1.0)
        return 1.0 - self.depth * x * x * (3.0 - 2.0 * x)


@dataclass(frozen=True, eq=False)
class Lights:
    """The light in one frame, in linear sRGB relative to white."""

    #: (3,) unit vector towards the key light.
    direction: np.ndarray
    #: (3,) irradiance of the key light.
    key: np.ndarray
    #: (3,) radiance of the sky from above, before occlusion.
    sky: np.ndarray
    #: (3,) radiance from below (table, floor).
    ground: np.ndarray
    #: Factor on everything at the end: what the exposure does.
    exposure: float = 1.0
    #: Shadow that something outside the image casts, or None.
    cast: CastShadow | None = None
    #: Lamps and windows besides the key light.
    lamps: tuple[AreaLight, ...] = ()
    #: (6, 3) radiance of the walls in +x, -x, +y, -y, +z, -z in place of the sky's, or None.
    room: np.ndarray | None = None
    #: Factor on the light that falls on the backdrop.
    backdrop: float = 1.0

    def tinted(self, tint: np.ndarray) -> Lights:
        """The same light behind a filter with a colour (3,)."""
        return replace(
            self,
            key=self.key * tint,
            sky=self.sky * tint,
            ground=self.ground * tint,
            lamps=tuple(replace(lamp, irradiance=lamp.irradiance * tint) for lamp in self.lamps),
            room=None if self.room is None else self.room * tint,
        )

    def on_backdrop(self) -> np.ndarray:
        """Light that the backdrop returns where it is white: (3,)."""
        light = 0.45 * self.key + 0.5 * (self.sky if self.room is None else self.room.mean(axis=0))
        wall = focus_point() + np.array([0.0, 0.0, BACKDROP_DISTANCE])
        for lamp in self.lamps:
            light = light + lamp.at(wall, np.array([0.0, 0.0, -1.0]))
        return np.asarray(light if self.backdrop == 1.0 else self.backdrop * light)


def steady_light(light: Light) -> Lights:
    """The scene's light where no effect changes it."""
    # Walls take the place of the sky: none of it is left.
    sky = light.sky if light.room is None else 0.0
    return Lights(
        direction=unit(np.array(light.direction)),
        key=light.key * lamp_color(light.kelvin),
        sky=sky * lamp_color(7000.0),
        ground=0.55 * sky * lamp_color(4800.0),
        lamps=tuple(area_light(lamp) for lamp in light.lamps),
        room=None if light.room is None else wall_radiance(light.room, light.sky),
        backdrop=light.backdrop,
    )
