"""The gallery of the documentation: a strip per capture, and one per perturbation."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np

from hwp_bench.base.files import atomic_write
from hwp_bench.base.progress import track
from hwp_bench.sim.camera import intrinsics
from hwp_bench.sim.effects import registered
from hwp_bench.sim.frame import FrameResult, render_frame
from hwp_bench.sim.plan import hands_at
from hwp_bench.sim.preview import strip
from hwp_bench.sim.scene import EffectCall, Scene, load_scene, scene_names
from hwp_bench.sim.seeds import generator
from hwp_bench.sim.subject import scene_hands
from hwp_bench.sim.variants import with_effects, with_severity
from hwp_bench.taxonomy import MAX_SEVERITY

#: Edge of a picture in pixels.
SIZE = 176
#: Pictures in the strip of a capture.
PICTURES = 8
#: Scene in which each perturbation is shown.
SHOWN_IN = (
    ("hand_object_interaction", "capture0"),
    ("complex_poses", "capture1"),
    ("illumination", "capture2"),
    ("motion_blur", "capture3"),
)
_QUALITY = 88


def write_gallery(folder: Path) -> list[Path]:
    """Write `captureN.jpg` for every scene and `severity-KIND.jpg` for every perturbation.

    Args:
        folder: where to.
    """
    paths = []
    for name in track(scene_names(), "Strips of the captures"):
        scene = load_scene(name)
        paths.append(_write(folder / f"{name}.jpg", strip(_capture_strip(scene), PICTURES)))
    for kind, name in track(SHOWN_IN, "Strips of the severities"):
        picture = strip(_severity_strip(load_scene(name), kind), MAX_SEVERITY + 1)
        paths.append(_write(folder / f"severity-{kind}.jpg", picture))
    return paths


def _capture_strip(scene: Scene) -> list[FrameResult]:
    """The middle of the first episodes of each effect in turn, between clean frames."""
    busy = [
        0.5 * (part.start + part.end)
        for step in range(3)
        for call in scene.effects
        for part in call.episodes[step : step + 1]
    ][: PICTURES - 3]
    moments = sorted([0.0, *busy, 0.87, 0.96])
    moments += [0.8, 0.83, 0.99, 0.9]
    frames = [int(moment * scene.frame_count) for moment in sorted(moments[:PICTURES])]
    return [render_frame(scene, frame, scene.frame_count, SIZE) for frame in frames]


def _severity_strip(scene: Scene, kind: str) -> list[FrameResult]:
    """One frame at severity 0 to 5, with nothing else acting."""
    call = scene.effect(kind)
    assert call is not None
    part = call.episodes[0]
    frame = int(0.5 * (part.start + part.end) * scene.frame_count)
    results: list[FrameResult] = []
    for severity in range(1, MAX_SEVERITY + 1):
        alone = with_severity(with_effects(scene, [kind]), severity)
        result = render_frame(alone, frame, scene.frame_count, SIZE)
        if not results:
            results.append(_clean_twin(result))
        results.append(_with_estimate(alone, call, result) if kind == "complex_poses" else result)
    return results


def _clean_twin(result: FrameResult) -> FrameResult:
    none = dict.fromkeys(result.plan.severity, 0)
    return replace(result, rgb=result.clean, plan=replace(result.plan, severity=none))


def _with_estimate(scene: Scene, call: EffectCall, result: FrameResult) -> FrameResult:
    """The frame with the joints where an estimator of this severity sees them."""
    import cv2
    import torch

    from hwp_bench.hands import pose_hand, project
    from hwp_bench.sim.camera import focus_point, viewmat
    from hwp_bench.sim.motion import hand_parameters

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


def _write(path: Path, picture: np.ndarray) -> Path:
    import cv2

    settings = [cv2.IMWRITE_JPEG_QUALITY, _QUALITY]
    _, data = cv2.imencode(".jpg", np.ascontiguousarray(picture[..., ::-1]), settings)
    return atomic_write(path, data.tobytes())
