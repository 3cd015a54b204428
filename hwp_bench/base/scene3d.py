"""3D pictures of surfaces, cameras and lines, drawn by pyvista without a display."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from hwp_bench.base.errors import MissingDependency
from hwp_bench.base.images import write_image

#: Edge of a picture in pixels, and its vertical angle of view, degrees.
EDGE, ANGLE = 900, 30.0
# Room around what is shown, as a share of it.
_ROOM = 1.15


@dataclass(frozen=True, eq=False)
class SideView:
    """Where a picture is seen from; the angle of view is `ANGLE`."""

    #: (3,) m, place of the eye, and the place that it looks at.
    eye: np.ndarray
    focus: np.ndarray
    #: (3,) what points up in the picture.
    up: np.ndarray


def see_whole(points: np.ndarray, direction: np.ndarray, up: np.ndarray) -> SideView:
    """Look along a direction from where all of (N, 3) points are in the picture."""
    middle = 0.5 * (points.min(axis=0) + points.max(axis=0))
    radius = max(float(np.linalg.norm(points - middle, axis=1).max()), 1e-3)
    away = _ROOM * radius / np.sin(np.radians(0.5 * ANGLE))
    return SideView(middle - away * direction / np.linalg.norm(direction), middle, up)


@contextmanager
def drawn(path: Path, view: SideView) -> Iterator[Any]:
    """Give a plotter to fill; its picture is written where the block ends well.

    Raises:
        MissingDependency: nothing can be drawn here.
    """
    import pyvista
    from vtkmodules.vtkCommonCore import vtkLogger

    # Without a display VTK warns that it has none before it draws off screen.
    vtkLogger.SetStderrVerbosity(vtkLogger.VERBOSITY_ERROR)
    try:
        plotter: Any = pyvista.Plotter(off_screen=True, window_size=[EDGE, EDGE])
        plotter.set_background("white")
        try:
            yield plotter
            plotter.camera_position = [view.eye, view.focus, view.up]
            plotter.camera.view_angle = ANGLE
            plotter.renderer.reset_camera_clipping_range()
            pixels = plotter.screenshot(None, return_img=True)
        finally:
            plotter.close()
    except (RuntimeError, OSError) as error:
        raise MissingDependency(
            f"3D pictures cannot be drawn here ({error})",
            remedy="VTK needs OpenGL: a display, EGL (Mesa's libegl1 will do), or OSMesa.",
        ) from error
    write_image(path, np.ascontiguousarray(pixels[..., :3]))


def surface_mesh(vertices: np.ndarray, faces: np.ndarray) -> Any:
    """The mesh of (V, 3) m and (F, 3)."""
    import pyvista

    cells = np.column_stack([np.full(len(faces), 3), faces])
    return pyvista.PolyData(np.asarray(vertices, dtype=np.float32), cells.reshape(-1))


def frustum_mesh(K: np.ndarray, viewmat: np.ndarray, width: int, height: int, depth: float) -> Any:
    """The pyramid that a camera sees, as deep as said, m; its first point is the camera."""
    corners = np.array([[x, y, 1.0] for y in (0.0, height) for x in (0.0, width)])
    rays = depth * np.linalg.solve(np.asarray(K, dtype=np.float64), corners.T).T
    points = np.vstack([np.zeros((1, 3)), rays])
    placed = (points - viewmat[:3, 3]) @ viewmat[:3, :3]
    return surface_mesh(placed, np.array([[0, 1, 2], [0, 2, 4], [0, 4, 3], [0, 3, 1]]))
