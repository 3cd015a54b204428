"""Pictures of a scene for people: a contact sheet and a short animation beside its clean twin."""

from __future__ import annotations

import io
from pathlib import Path

import numpy as np

from hwp_bench.base.errors import UsageError
from hwp_bench.base.files import atomic_write
from hwp_bench.base.images import write_image
from hwp_bench.base.progress import track
from hwp_bench.sim.frame import FrameResult, render_frame
from hwp_bench.sim.scene import Scene

#: Frames in a row of the sheet.
COLUMNS = 8
#: Duration of a frame of the animation, ms.
FRAME_MS = 140
_SHORT = {
    "hand_object_interaction": "hoi",
    "complex_poses": "cp",
    "illumination": "il",
    "motion_blur": "mb",
}


def write_preview(
    scene: Scene, folder: Path, *, frame_count: int = 48, size: int = 160
) -> tuple[Path, Path]:
    """Write `ID-sheet.png` and `ID.gif`, each frame beside its clean version.

    Args:
        scene: the scene.
        folder: where to.
        frame_count: 10 to 400 frames over the whole capture.
        size: edge of a frame in pixels, 32 to 512.

    Raises:
        UsageError: a number is out of range.
    """
    if not 10 <= frame_count <= 400 or not 32 <= size <= 512:
        raise UsageError("10 to 400 frames of 32 to 512 px are drawn", field="--frames, --size")
    results = [
        render_frame(scene, frame, frame_count, size)
        for frame in track(range(frame_count), f"Rendering {scene.id}")
    ]
    sheet = write_image(folder / f"{scene.id}-sheet.png", strip(results, COLUMNS))
    return sheet, atomic_write(folder / f"{scene.id}.gif", _animation(results))


def strip(results: list[FrameResult], columns: int) -> np.ndarray:
    """Frames in rows, left to right, each with its number and what perturbs it."""
    cells = [_captioned(result) for result in results]
    blank = np.zeros_like(cells[0])
    cells += [blank] * (-len(cells) % columns)
    rows = [
        np.concatenate(cells[start : start + columns], axis=1)
        for start in range(0, len(cells), columns)
    ]
    return np.concatenate(rows, axis=0)


def _captioned(result: FrameResult) -> np.ndarray:
    import cv2

    image = result.rgb.copy()
    severity = [
        f"{_SHORT.get(name, name)}{value}" for name, value in result.plan.severity.items() if value
    ]
    text = " ".join([str(result.plan.frame), *severity])
    scale = len(image) / 420.0
    for color, width in (((0, 0, 0), 3), ((255, 255, 255), 1)):
        place = (4, int(36 * scale))
        cv2.putText(image, text, place, cv2.FONT_HERSHEY_SIMPLEX, scale, color, width, cv2.LINE_AA)
    return image


def _animation(results: list[FrameResult]) -> bytes:
    from PIL import Image

    frames = [
        Image.fromarray(np.concatenate([result.rgb, result.clean], axis=1)).quantize(128)
        for result in results
    ]
    buffer = io.BytesIO()
    frames[0].save(
        buffer, format="GIF", save_all=True, append_images=frames[1:], duration=FRAME_MS, loop=0
    )
    return buffer.getvalue()
