"""Camera and light of a scene: intrinsics, path and rays; all lights, and passing shadows."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from hwp_bench.base.colors import lamp_color
from hwp_bench.sim.geometry.mesh import unit
from hwp_bench.sim.geometry.noise import generator
from hwp_bench.sim.scene.area_lights import (
    BACKDROP_DISTANCE,
    AreaLight,
    area_light,
    wall_radiance,
)
from hwp_bench.sim.scene.schema import Light, Scene

#: Distance from the camera to the point that it looks at, m.
FOCUS_DISTANCE = 0.5


def focus_point() -> np.ndarray:
    """The point that places are relative to: (3,) m, world."""
    return np.array([0.0, 0.0, FOCUS_DISTANCE])


def intrinsics(scene: Scene, size: int) -> np.ndarray:
    """(3, 3) K in pixels of a square image."""
    focal = 0.5 * size / np.tan(np.radians(scene.camera.field_of_view) / 2.0)
    return np.array([[focal, 0.0, size / 2], [0.0, focal, size / 2], [0.0, 0.0, 1.0]])


def viewmat(scene: Scene, seconds: float) -> np.ndarray:
    """(4, 4) world to camera; a camera that stands still has the identity."""
    if not scene.camera.handheld:
        return np.eye(4)
    from scipy.spatial.transform import Rotation

    rng = generator(scene.seed, "camera")
    rates = rng.uniform(0.4, 2.2, (2, 6))
    phases = rng.uniform(0.0, 2.0 * np.pi, (2, 6))
    waves = np.sin(rates * seconds + phases)
    waves = 0.7 * waves[0] + 0.3 * waves[1]
    view = np.eye(4)
    view[:3, :3] = Rotation.from_rotvec(0.012 * waves[:3]).as_matrix()
    # The camera sways around the point that it looks at.
    focus = focus_point()
    view[:3, 3] = focus - view[:3, :3] @ focus - scene.camera.sway * waves[3:]
    return view


def pixel_rays(
    K: np.ndarray,
    view: np.ndarray,
    box: tuple[int, int, int, int],
    grid: int,
    shift: tuple[float, float] = (0.0, 0.0),
) -> tuple[np.ndarray, np.ndarray]:
    """Rays through a regular grid inside every pixel.

    Args:
        K: (3, 3) px.
        view: (4, 4) world to camera.
        box: top, bottom, left, right: the rows and columns to cover.
        grid: edge of the grid inside a pixel.
        shift: moves the grid right and down, in steps of the grid.

    Returns:
        origin (3,) m and directions (rows * grid, columns * grid, 3), world, with length 1
        along the camera's axis.
    """
    top, bottom, left, right = box
    across = left + (np.arange((right - left) * grid) + 0.5 + shift[0]) / grid
    down = top + (np.arange((bottom - top) * grid) + 0.5 + shift[1]) / grid
    x, y = np.meshgrid((across - K[0, 2]) / K[0, 0], (down - K[1, 2]) / K[1, 1])
    in_camera = np.stack([x, y, np.ones_like(x)], axis=-1)
    turn = view[:3, :3]
    return -turn.T @ view[:3, 3], in_camera @ turn


@dataclass(frozen=True, eq=False)
class CastShadow:
    """A soft-edged shadow over one side of the scene."""

    #: (3,) unit vector across the edge, into the shadow.
    across: np.ndarray
    #: Where the edge is along it, m.
    edge: float
    #: Width of the edge, m.
    width: float
    #: Share of the key light that is lost inside, 0-1.
    depth: float

    def passed(self, points: np.ndarray) -> np.ndarray:
        """Share of the key light that passes at (N, 3) points: (N,)."""
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
        lamps=tuple(area_light(lamp, focus_point()) for lamp in light.lamps),
        room=None if light.room is None else wall_radiance(light.room, light.sky),
        backdrop=light.backdrop,
    )
