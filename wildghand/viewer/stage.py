"""A 3D picture of an avatar's Gaussians in one frame, with the cameras of the clip."""

from __future__ import annotations

import os
from pathlib import Path

import numpy as np
import trimesh
from scipy.spatial.transform import Rotation

from hwp_bench.base.arrays import evenly
from hwp_bench.base.scene3d import SideView, drawn, frustum_mesh, see_whole, surface_mesh
from hwp_bench.capture import Cameras, Capture
from wildghand.avatar.avatar import PosedGaussians, WildGHandAvatar
from wildghand.export.splats import standing

#: Most cameras whose pyramids are drawn, spread evenly over the clip, and how deep, as a share of
#: the distance to the hands.
MAX_CAMERAS, DEPTH = 12, 0.25
#: Ellipsoids are drawn at so many standard deviations; Gaussians below an opacity are left out.
DEVIATIONS, LEAST_OPACITY = 1.5, 0.1
# Directions that the eye is turned from that of the camera, degrees: from the side and above.
_ASIDE, _ABOVE = 65.0, 20.0


def draw_stage(
    avatar: WildGHandAvatar, capture: Capture, frame: int, path: str | os.PathLike[str]
) -> int:
    """Write a picture of the Gaussians of a frame as ellipsoids, and of the clip's cameras.

    The camera of the frame is red, others are grey, and a red line joins them all.

    Returns:
        the number of Gaussians.
    """
    place = standing(avatar, capture, frame)
    posed = avatar.pose(place.hands, closed=True, viewmat=place.viewmat)
    draw_gaussians(posed, capture.cameras, frame, capture.size, path)
    return len(posed)


def draw_gaussians(
    posed: PosedGaussians,
    cameras: Cameras,
    frame: int,
    size: tuple[int, int],
    path: str | os.PathLike[str],
) -> SideView:
    """Write a picture of Gaussians and cameras, that of a frame in red; see `draw_stage`."""
    import pyvista

    posed.require_finite()
    height, width = size
    views = cameras.viewmats
    places = -np.einsum("fji,fj->fi", views[:, :3, :3], views[:, :3, 3])
    middle = posed.means.mean(axis=0, dtype=np.float64)
    depth = DEPTH * float(np.linalg.norm(middle - places[frame]))
    chosen = [row for row in evenly(len(views), MAX_CAMERAS).tolist() if row != frame]
    pyramids = {
        row: frustum_mesh(cameras.Ks[row], views[row], width, height, depth)
        for row in (*chosen, frame)
    }
    corners = [np.asarray(mesh.points) for mesh in pyramids.values()]
    everything = np.concatenate([posed.means, *corners]).astype(np.float64)
    view = see_whole(everything, _aside(views[frame]), -views[frame, 1, :3])
    mesh, colors = _ellipsoids(posed)
    with drawn(Path(path), view) as plotter:
        plotter.add_mesh(mesh, scalars=colors, rgb=True, lighting=False)
        for row, pyramid in pyramids.items():
            color, thick = ("#cc3311", 3) if row == frame else ("#888888", 1)
            style = {"style": "wireframe", "lighting": False, "line_width": thick}
            plotter.add_mesh(pyramid, color=color, **style)
        if np.ptp(places, axis=0).max() > 0.0:
            line = pyvista.lines_from_points(places)
            plotter.add_mesh(line, color="#cc3311", line_width=2, lighting=False)
    return view


def _aside(viewmat: np.ndarray) -> np.ndarray:
    """(3,) the direction in which a picture looks: that of a camera, turned aside and down."""
    turn = Rotation.from_euler("yx", [-_ASIDE, -_ABOVE], degrees=True).as_matrix()
    return np.asarray(viewmat[:3, :3].T @ turn @ np.array([0.0, 0.0, 1.0]))


def _ellipsoids(posed: PosedGaussians) -> tuple[object, np.ndarray]:
    """All Gaussians as one mesh, and the colours of its points, uint8."""
    ball = trimesh.creation.icosphere(subdivisions=1)
    seen = posed.opacities >= LEAST_OPACITY
    turns = Rotation.from_quat(np.roll(posed.quats[seen], -1, axis=1)).as_matrix()
    axes = turns * (DEVIATIONS * posed.scales[seen])[:, None, :]
    points = np.einsum("nij,pj->npi", axes, ball.vertices) + posed.means[seen, None]
    count, each = points.shape[:2]
    faces = ball.faces[None] + each * np.arange(count)[:, None, None]
    colors = np.rint(255.0 * posed.colors[seen].clip(0.0, 1.0)).astype(np.uint8)
    mesh = surface_mesh(points.reshape(-1, 3), faces.reshape(-1, 3))
    return mesh, np.repeat(colors, each, axis=0)
