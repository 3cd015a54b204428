"""The camera of a scene: intrinsics, path, and the rays of its pixels."""

from __future__ import annotations

import numpy as np

from hwp_bench.sim.scene import Scene
from hwp_bench.sim.seeds import generator

#: Distance from the camera to the point that it looks at, m.
FOCUS_DISTANCE = 0.5


def focus_point() -> np.ndarray:
    """The point that places are relative to: (3,) m, world."""
    return np.array([0.0, 0.0, FOCUS_DISTANCE])


def intrinsics(scene: Scene, size: int) -> np.ndarray:
    """(3, 3) K in pixels of a square picture."""
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
        box: top, bottom, left, right: the rows and columns wanted.
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
