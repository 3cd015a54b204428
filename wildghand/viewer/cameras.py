"""Between the camera of a page and ours: both are pinholes with OpenCV axes."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from hwp_bench.methods.contract import Camera


@dataclass(frozen=True, eq=False)
class PageCamera:
    """The camera of a page, as it was last told."""

    #: (4,) (w, x, y, z), camera to world.
    wxyz: np.ndarray
    #: (3,) m, world.
    position: np.ndarray
    #: Vertical field of view, rad.
    fov: float
    #: Of the page's picture, px.
    width: int
    #: Of the page's picture, px.
    height: int

    def sound(self) -> bool:
        """Whether a picture can be drawn for it: a page's numbers are not ours."""
        numbers = [*np.ravel(self.wxyz), *np.ravel(self.position), self.fov]
        return (
            all(math.isfinite(number) for number in numbers)
            and float(np.linalg.norm(self.wxyz)) > 1e-6
            and 0.01 < self.fov < 3.1
            and min(self.width, self.height) >= 1
            and max(self.width, self.height) < 100 * min(self.width, self.height)
        )

    def camera(self, edge: int) -> Camera:
        """Return our camera for a picture whose larger side is at most `edge` px.

        The picture has the page's shape up to a pixel, and is never larger than the page's own.
        """
        scale = min(1.0, edge / max(self.width, self.height))
        width = max(1, round(scale * self.width))
        height = max(1, round(scale * self.height))
        # The page stretches the picture to its own shape, so each axis has a focal length.
        focal = 0.5 / math.tan(0.5 * self.fov)
        K = np.array(
            [
                [focal * self.height * width / self.width, 0.0, 0.5 * width],
                [0.0, focal * height, 0.5 * height],
                [0.0, 0.0, 1.0],
            ]
        )
        w, x, y, z = np.asarray(self.wxyz, dtype=np.float64)
        turn = Rotation.from_quat([x, y, z, w]).inv().as_matrix()
        viewmat = np.eye(4)
        viewmat[:3, :3] = turn
        viewmat[:3, 3] = -turn @ np.asarray(self.position, dtype=np.float64)
        return Camera(K, viewmat, width, height)


@dataclass(frozen=True, eq=False)
class Viewpoint:
    """Where a page's camera is put."""

    #: (3,) m, world.
    position: np.ndarray
    #: (3,) m, the point that it looks at and turns about.
    look_at: np.ndarray
    #: (3,) direction that is up in the picture.
    up: np.ndarray
    #: Vertical field of view, rad.
    fov: float


def viewpoint(camera: Camera, centre: np.ndarray) -> Viewpoint:
    """Return the viewpoint of one of our cameras.

    Args:
        camera: its principal point counts as the middle of the picture.
        centre: (3,) m, world, about what the page's camera turns; the nearest point to it on the
            camera's axis is taken, so that the picture stays the camera's.
    """
    turn, shift = camera.viewmat[:3, :3], camera.viewmat[:3, 3]
    position, ahead = -turn.T @ shift, turn[2]
    depth = max(float((np.asarray(centre) - position) @ ahead), 1e-2)
    fov = 2.0 * math.atan(0.5 * camera.height / float(camera.K[1, 1]))
    return Viewpoint(position, position + depth * ahead, -turn[1], fov)
