"""Images of a scene for people: contact sheet, animation, and a 3D view from the side."""

from __future__ import annotations

import io
from pathlib import Path

import numpy as np

from hwp_bench.base.console import track
from hwp_bench.base.errors import UsageError
from hwp_bench.base.files import atomic_write
from hwp_bench.base.images import write_image
from hwp_bench.base.scene3d import SideView, drawn, frustum_mesh, surface_mesh
from hwp_bench.sim.effects import hands_at, lights_at, objects_at, plan_frame
from hwp_bench.sim.geometry.surface import RenderCost
from hwp_bench.sim.light.lights import focus_point
from hwp_bench.sim.render.frame import SimulatedFrame, render_frame
from hwp_bench.sim.render.stage import RenderStage
from hwp_bench.sim.scene.scene import Scene, intrinsics, viewmat
from hwp_bench.sim.subject.hand import MOVING
from hwp_bench.taxonomy import perturbation


def captioned(image: np.ndarray, text: str) -> np.ndarray:
    """A copy of an image (H, W, 3) uint8 with a text in its upper left corner."""
    import cv2

    drawn = image.copy()
    scale = len(image) / 420.0
    for color, width in (((0, 0, 0), 3), ((255, 255, 255), 1)):
        place = (4, int(36 * scale))
        cv2.putText(drawn, text, place, cv2.FONT_HERSHEY_SIMPLEX, scale, color, width, cv2.LINE_AA)
    return drawn


#: Frames in a row of the sheet.
SHEET_COLUMNS = 8


#: Duration of a frame of the animation, ms.
FRAME_MS = 140


def write_preview(
    scene: Scene, folder: Path, *, frame_count: int = 48, size: int = 160
) -> tuple[Path, Path]:
    """Write `ID-sheet.png` and `ID.gif`, each frame next to its clean version."""
    if not 10 <= frame_count <= 400 or not 32 <= size <= 512:
        raise UsageError(
            "10 to 400 frames of 32 to 512 px are drawn", field="--frame-count, --size"
        )
    results = [
        render_frame(scene, frame, frame_count, size)
        for frame in track(range(frame_count), f"Rendering {scene.id}")
    ]
    sheet = write_image(folder / f"{scene.id}-sheet.png", strip(results, SHEET_COLUMNS))
    return sheet, atomic_write(folder / f"{scene.id}.gif", _animation(results))


def strip(results: list[SimulatedFrame], columns: int) -> np.ndarray:
    """Frames in rows, left to right, each with its number and what perturbs it."""
    cells = [_captioned(result) for result in results]
    blank = np.zeros_like(cells[0])
    cells += [blank] * (-len(cells) % columns)
    rows = [
        np.concatenate(cells[start : start + columns], axis=1)
        for start in range(0, len(cells), columns)
    ]
    return np.concatenate(rows, axis=0)


def _captioned(result: SimulatedFrame) -> np.ndarray:
    acting = ((name, value) for name, value in result.plan.severity.items() if value)
    words = [f"{perturbation(name).short}{value}" for name, value in acting]
    return captioned(result.rgb, " ".join([str(result.plan.frame), *words]))


def _animation(results: list[SimulatedFrame]) -> bytes:
    from PIL import Image

    pairs = [np.concatenate([result.rgb, result.clean], axis=1) for result in results]
    frames = [Image.fromarray(pair).quantize(128) for pair in pairs]
    buffer = io.BytesIO()
    frames[0].save(
        buffer, format="GIF", save_all=True, append_images=frames[1:], duration=FRAME_MS, loop=0
    )
    return buffer.getvalue()


# Moments of the camera's path that are drawn.
_PATH = 200
# How deep the camera's pyramid is drawn, and how far from the hands the lamp, m.
_DEPTH, _LAMP = 0.2, 0.25


def draw_stage(scene: Scene, folder: Path) -> Path:
    """Write `ID-stage.png`: the busiest frame of the scene, seen from the side."""
    import pyvista

    plans = [plan_frame(scene, frame, 100, 256) for frame in range(100)]
    recipe = max(plans, key=lambda item: ("objects" in item.passes, sum(item.severity.values())))
    stage = RenderStage(scene, RenderCost())
    hands = hands_at(scene, recipe.seconds)
    things = stage.things(objects_at(scene, recipe, recipe.seconds), hands)
    lights = lights_at(scene, recipe)
    views = [viewmat(scene, moment * scene.duration) for moment in np.linspace(0.0, 1.0, _PATH)]
    path = np.array([-view[:3, :3].T @ view[:3, 3] for view in views])
    out = folder / f"{scene.id}-stage.png"
    focus = focus_point()
    lamp = focus + _LAMP * lights.direction
    with drawn(out, stage_side()) as plotter:
        surface = stage.surface(hands, MOVING)
        mesh = surface_mesh(surface.vertices, surface.faces)
        plotter.add_mesh(mesh, color="#d8a888", smooth_shading=True)
        if things is not None:
            mesh = surface_mesh(things.surface.vertices, things.surface.faces)
            plotter.add_mesh(mesh, color="#4477aa")
        plotter.add_mesh(pyvista.Sphere(radius=0.012, center=lamp), color="#ffcc33", lighting=False)
        plotter.add_mesh(pyvista.Line(lamp, focus), color="#ffcc33", line_width=2)
        camera = frustum_mesh(intrinsics(scene, 1), np.eye(4), 1, 1, _DEPTH)
        plotter.add_mesh(camera, color="#666666", style="wireframe", lighting=False)
        if scene.camera.handheld:
            line = pyvista.lines_from_points(path)
            plotter.add_mesh(line, color="#cc3311", line_width=3, lighting=False)
    return out


def stage_side() -> SideView:
    """The side from which a stage is seen."""
    focus = focus_point()
    eye = focus + np.array([1.25, -0.55, -0.45])
    return SideView(eye, focus + np.array([0.0, 0.05, -0.22]), np.array([0.0, -1.0, 0.0]))
