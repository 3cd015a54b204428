"""Images of a scene for people: contact sheet and animation, and the documentation's gallery."""

from __future__ import annotations

import io
from dataclasses import replace
from pathlib import Path

import numpy as np

from hwp_bench.base.arrays import evenly
from hwp_bench.base.console import track
from hwp_bench.base.errors import UsageError
from hwp_bench.base.files import atomic_write
from hwp_bench.base.images import write_image
from hwp_bench.sim.effects.base import registered
from hwp_bench.sim.effects.plan import hands_at
from hwp_bench.sim.geometry.noise import generator
from hwp_bench.sim.geometry.raycast import RenderCost
from hwp_bench.sim.produce.free_view import free_views, render_free
from hwp_bench.sim.produce.light_strips import camera_sheet, captioned, light_sheet
from hwp_bench.sim.produce.look_strips import look_sheet
from hwp_bench.sim.produce.video_encoding import has_encoder
from hwp_bench.sim.render.frame import SimulatedFrame, render_frame
from hwp_bench.sim.render.view import steady_gain
from hwp_bench.sim.scene.free_view import FRAMES
from hwp_bench.sim.scene.motion import hand_parameters
from hwp_bench.sim.scene.optics import focus_point, intrinsics, viewmat
from hwp_bench.sim.scene.reader import load_scene, scene_names
from hwp_bench.sim.scene.schema import EffectCall, Scene, with_effects, with_severity
from hwp_bench.sim.subject.hand import scene_hands
from hwp_bench.taxonomy import MAX_SEVERITY, perturbation

#: Frames in a row of the sheet.
COLUMNS = 8
#: Duration of a frame of the animation, ms.
FRAME_MS = 140
#: Edge of an image in pixels.
GALLERY_SIZE = 176
#: Images in the strip of a capture.
STRIP_FRAMES = 8
#: Scene in which each perturbation is shown.
SHOWN_IN = (
    ("hand_object_interaction", "capture0"),
    ("complex_poses", "capture1"),
    ("illumination", "capture2"),
    ("motion_blur", "capture3"),
)
#: Scenes whose free-view clips are shown.
FREE_SHOWN = ("capture2", "capture4")
_QUALITY = 88


def write_preview(
    scene: Scene, folder: Path, *, frame_count: int = 48, size: int = 160
) -> tuple[Path, Path]:
    """Write `ID-sheet.png` and `ID.gif`, each frame next to its clean version.

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


def write_gallery(folder: Path) -> list[Path]:
    """Write `captureN.jpg`, `severity-KIND.jpg`, `free-view.jpg`, and the sheets by name.

    The sheets are `lights.jpg`, `looks.jpg` and `cameras.jpg`.

    The last one is left out where nothing can encode H.264.

    Args:
        folder: where to.
    """
    paths = []
    for name in track(scene_names(), "Strips of the captures"):
        scene = load_scene(name)
        paths.append(_write(folder / f"{name}.jpg", strip(_capture_strip(scene), STRIP_FRAMES)))
    for kind, name in track(SHOWN_IN, "Strips of the severities"):
        image = strip(_severity_strip(load_scene(name), kind), MAX_SEVERITY + 1)
        paths.append(_write(folder / f"severity-{kind}.jpg", image))
    rows = [free_view_strip(load_scene(name)) for name in FREE_SHOWN]
    paths.append(_write(folder / "free-view.jpg", np.concatenate(rows)))
    paths.append(_write(folder / "lights.jpg", light_sheet()))
    paths.append(_write(folder / "looks.jpg", look_sheet()))
    if has_encoder():
        paths.append(_write(folder / "cameras.jpg", camera_sheet()))
    return paths


def free_view_strip(scene: Scene) -> np.ndarray:
    """Two rows of frames of the free-view clip, with their numbers."""
    cost = RenderCost()
    gain = steady_gain(scene, cost)
    picks = evenly(FRAMES, 2 * STRIP_FRAMES).tolist()
    views = free_views(scene)
    cells = []
    for frame in picks:
        _, image, _ = render_free(scene, views[frame], GALLERY_SIZE, gain, cost)
        cells.append(captioned(image, str(frame)))
    rows = cells[:STRIP_FRAMES], cells[STRIP_FRAMES:]
    return np.concatenate([np.concatenate(row, axis=1) for row in rows])


def _capture_strip(scene: Scene) -> list[SimulatedFrame]:
    """The middle of the first episodes of each effect in turn, between clean frames."""
    busy = [
        0.5 * (part.start + part.end)
        for step in range(3)
        for call in scene.effects
        for part in call.episodes[step : step + 1]
    ][: STRIP_FRAMES - 3]
    moments = sorted([0.0, *busy, 0.87, 0.96])
    moments += [0.8, 0.83, 0.99, 0.9]
    frames = [int(moment * scene.frame_count) for moment in sorted(moments[:STRIP_FRAMES])]
    return [render_frame(scene, frame, scene.frame_count, GALLERY_SIZE) for frame in frames]


def _severity_strip(scene: Scene, kind: str) -> list[SimulatedFrame]:
    """One frame at severity 0 to 5, with nothing else acting."""
    call = scene.effect(kind)
    assert call is not None
    part = call.episodes[0]
    frame = int(0.5 * (part.start + part.end) * scene.frame_count)
    results: list[SimulatedFrame] = []
    for severity in range(1, MAX_SEVERITY + 1):
        alone = with_severity(with_effects(scene, [kind]), severity)
        result = render_frame(alone, frame, scene.frame_count, GALLERY_SIZE)
        if not results:
            results.append(_clean_twin(result))
        results.append(_with_estimate(alone, call, result) if kind == "complex_poses" else result)
    return results


def _clean_twin(result: SimulatedFrame) -> SimulatedFrame:
    none = dict.fromkeys(result.plan.severity, 0)
    return replace(result, rgb=result.clean, plan=replace(result.plan, severity=none))


def _with_estimate(scene: Scene, call: EffectCall, result: SimulatedFrame) -> SimulatedFrame:
    """The frame with the joints where an estimator of this severity sees them."""
    import cv2
    import torch

    from hwp_bench.hands import pose_hand, project

    seconds = result.plan.seconds
    angle, length = registered(call.kind).estimate_error(result.plan.strength[call.kind])
    rng = generator(scene.seed, "gallery")
    image = result.rgb.copy()
    for side, moment in hands_at(scene, seconds).items():
        hand = scene_hands(scene)[side]
        pose, transl = hand_parameters(moment, side, hand.joints, focus_point())
        pose = pose + angle * rng.normal(size=pose.shape)
        transl = transl + length * rng.normal(size=3)
        arrays = (pose[None], hand.betas, transl[None])
        posed = pose_hand(hand.tensors, *(torch.as_tensor(array) for array in arrays))
        view = torch.as_tensor(viewmat(scene, seconds))[None]
        K = torch.as_tensor(intrinsics(scene, len(image)))[None]
        pixels = project(posed.landmarks, view, K)[0][0].numpy()
        for first in range(1, 21, 4):
            chain = np.vstack([pixels[:1], pixels[first : first + 4]])
            cv2.polylines(
                image, [np.round(chain).astype(np.int32)], False, (255, 140, 0), 1, cv2.LINE_AA
            )
    return replace(result, rgb=image)


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
    severity = [
        f"{perturbation(name).short}{value}"
        for name, value in result.plan.severity.items()
        if value
    ]
    return captioned(result.rgb, " ".join([str(result.plan.frame), *severity]))


def _animation(results: list[SimulatedFrame]) -> bytes:
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


def _write(path: Path, image: np.ndarray) -> Path:
    import cv2

    settings = [cv2.IMWRITE_JPEG_QUALITY, _QUALITY]
    _, data = cv2.imencode(".jpg", np.ascontiguousarray(image[..., ::-1]), settings)
    return atomic_write(path, data.tobytes())
