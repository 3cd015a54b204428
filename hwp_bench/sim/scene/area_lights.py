"""Area lights and coloured walls as the renderer needs them: places, vectors, linear light."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from hwp_bench.base.colors import lamp_color, srgb_to_linear
from hwp_bench.sim.geometry.mesh import unit
from hwp_bench.sim.scene.lighting import Lamp, Room

#: Distance of the backdrop behind the point looked at, m, for the light that falls on it.
BACKDROP_DISTANCE = 1.0
#: Share of a cube's face that a patch in its middle sees of the side it faces, and of each side
#: that borders it; the sixth lies behind. Source: view factor of a square from the centre of the
#: opposite face, (4 / pi) / sqrt(2) * atan(1 / sqrt(2)) = 0.5541, and a quarter of the rest.
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

    def turned(self, rotation: np.ndarray, about: np.ndarray) -> AreaLight:
        """The light turned by a (3, 3) rotation about a point (3,)."""
        return replace(
            self,
            centre=about + rotation @ (self.centre - about),
            across=rotation @ self.across,
            down=rotation @ self.down,
            facing=rotation @ self.facing,
        )

    def at(self, points: np.ndarray, normal: np.ndarray) -> np.ndarray:
        """Irradiance at (3,) points of a surface with a normal (3,), from the centre: (3,)."""
        way = self.centre - points
        squared = float(way @ way)
        cosine = float(way @ normal) / np.sqrt(squared)
        leaving = -float(way @ self.facing) / np.sqrt(squared)
        share = max(cosine, 0.0) * max(leaving, 0.0) * self.distance**2 / squared
        return np.asarray(share * self.irradiance)


def area_light(lamp: Lamp, focus: np.ndarray) -> AreaLight:
    """The light of a lamp, given the point looked at (3,) in the world."""
    place = np.array(lamp.place)
    facing = -unit(place)
    # Upright as far as it can be; a lamp straight above has its width from left to right.
    upright = np.array([0.0, 1.0, 0.0]) if abs(facing[1]) < 0.99 else np.array([0.0, 0.0, 1.0])
    across = unit(np.cross(upright, facing))
    down = np.cross(facing, across)
    height = lamp.height or lamp.width
    return AreaLight(
        centre=focus + place,
        across=0.5 * lamp.width * across,
        down=0.5 * height * down,
        facing=facing,
        distance=float(np.linalg.norm(place)),
        irradiance=lamp.strength * lamp_color(lamp.kelvin) * srgb_to_linear(np.array(lamp.color)),
        through=lamp.through,
    )


def wall_radiance(room: Room, sky: float) -> np.ndarray:
    """Linear radiance of the walls in the directions +x, -x, +y, -y, +z, -z: (6, 3).

    Args:
        room: their colours.
        sky: radiance of a white wall.
    """
    walls = (room.right, room.left, room.floor, room.ceiling, room.far, room.near)
    return np.asarray(sky * srgb_to_linear(np.array(walls)))


def wall_irradiance(radiance: np.ndarray) -> np.ndarray:
    """Irradiance over pi in the middle of a cube of walls, for normals along the axes: (6, 3).

    Args:
        radiance: (6, 3) as `wall_radiance` gives it.
    """
    behind = radiance.reshape(3, 2, 3)[:, ::-1].reshape(6, 3)
    borders = radiance.sum(axis=0) - radiance - behind
    return np.asarray(FACING_SHARE * radiance + BORDER_SHARE * borders)
