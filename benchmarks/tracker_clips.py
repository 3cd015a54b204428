"""Simulated clips that pass the importer, where its errors are known.

Their true landmarks get errors with the covariance, growth and memory of a real clip's
(`benchmarks/landmark_errors.py`).
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
import torch

from benchmarks.landmark_errors import LandmarkErrors
from hwp_bench.capture import Capture, open_capture
from hwp_bench.hands import HandTemplate, load_template, pose_hand
from hwp_bench.hands.skeleton import HandParameters
from hwp_bench.importers.video import SolveSettings, VideoImport
from hwp_bench.importers.video.api import fit_video
from hwp_bench.importers.video.source import VideoSource, read_source
from hwp_bench.sim.produce.capture import render_capture
from hwp_bench.sim.produce.estimates import curl, edge_on
from hwp_bench.sim.scene_files import parse_scene

#: Frames, rate and size of a simulated clip.
FRAMES, FPS, SIZE = 240, 30.0, 256
_KEYS = (
    ("open", 180, 0, 0),
    ("fist", 170, 0, 0),
    ("point", 200, 10, 0),
    ("open", 250, 0, 0),
    ("pinch", 165, 0, 0),
    ("fist", 230, 0, 0),
    ("victory", 150, 0, 15),
)
_PARTS = ("pose", "betas", "transl", "valid")


@dataclass(frozen=True)
class ClipKind:
    """What simulated clips show."""

    #: Strength of the lamp, and of the sky.
    key: float = 0.6
    sky: float = 0.35
    #: Entries of the table `subject.anatomy`; empty where the person is a shape of the hand model.
    anatomy: str = ""


#: By name. The first is what the importer was made with; nothing was chosen by the others.
KINDS = {
    "": ClipKind(),
    "hard-light": ClipKind(key=0.95, sky=0.15),
    "off-model": ClipKind(
        anatomy="bone_length = 4.0\nthickness = 6.0\njoint_shift = 4.0\nfolds = 0.5\nknuckles = 1.0"
    ),
}


@dataclass(frozen=True, eq=False)
class RoundTrip:
    """Parameters that came out of the importer, and the true ones; the camera is at the origin."""

    #: As estimated.
    estimate: HandParameters
    #: As rendered.
    truth: HandParameters


def round_trip(seed: int, errors: LandmarkErrors, keep: Path) -> RoundTrip:
    """Render a clip, track it with errors, import it; kept in a folder and read from there."""
    file = keep / f"clip{seed}.npz"
    if not file.exists():
        clip = make_clip(seed, "", errors, keep)
        _, truth = true_hand(keep / clip)
        hand = fit_video(*clip_source(clip, keep)).first.parameters
        np.savez(
            file,
            **{f"estimate_{part}": getattr(hand, part) for part in _PARTS},
            **{f"truth_{part}": getattr(truth, part) for part in _PARTS},
        )
    with np.load(file) as stored:
        estimate, truth = (
            HandParameters(*(stored[f"{name}_{part}"] for part in _PARTS))
            for name in ("estimate", "truth")
        )
    return RoundTrip(estimate, truth)


def make_clip(seed: int, kind: str, errors: LandmarkErrors, keep: Path) -> str:
    """Render a clip and track it with errors, where a folder does not hold it yet.

    Args:
        seed: of the person, the motion and the errors.
        kind: a name of `KINDS`.
        errors: of landmarks.
        keep: the folder: gets the capture, the video and its landmarks.

    Returns:
        The clip's name: that of its capture, and of its video without the suffix.
    """
    clip = f"clip{seed}-{kind}" if kind else f"clip{seed}"
    if _landmarks(clip, keep).exists():
        return clip
    scene = parse_scene(scene_text(clip, seed, KINDS[kind]), where=clip)
    capture = render_capture(
        scene, keep / clip, size=SIZE, workers=1, overwrite=True, free_view=False
    )
    template, truth = true_hand(keep / clip)
    posed = pose_hand(
        template.to_torch(torch.float64),
        *(torch.from_numpy(array) for array in (truth.pose, truth.betas, truth.transl)),
    )
    points = posed.landmarks.numpy()
    pixels = (points / points[..., 2:]) @ capture.cameras.Ks[0].T
    boxes = pixels[..., :2].max(axis=1) - pixels[..., :2].min(axis=1)
    still, bent, turned = errors.growth
    grown = still + bent * curl(truth.pose) + turned * edge_on(points)
    image, world = _drawn(errors, grown, np.random.default_rng(seed))
    image *= float(np.median(boxes.max(axis=1)))
    _write_video(capture, keep / f"{clip}.avi")
    centred = points - points.mean(axis=1, keepdims=True)
    arrays = {"image": pixels[..., :2] + image, "world": centred + world, "score": np.ones(FRAMES)}
    np.savez(_landmarks(clip, keep), **arrays)
    return clip


def true_hand(root: Path) -> tuple[HandTemplate, HandParameters]:
    """The right hand of a clip's capture, and the template that it is posed with.

    The template is the person's own where the person is no shape of the hand model.
    """
    capture = open_capture(root)
    truth = (capture.true_hands or {})["right"]
    if KINDS[root.name.partition("-")[2]].anatomy:
        return capture.true_template("right"), truth
    return load_template("anny", "right"), truth


def clip_source(
    clip: str, keep: Path, settings: SolveSettings | None = None
) -> tuple[VideoSource, VideoImport]:
    """A kept clip as the importer reads it, and the choices, among them the true focal length."""
    capture = open_capture(keep / clip)
    focal, fit = float(capture.cameras.Ks[0][0, 0]), settings or SolveSettings()
    options = VideoImport(side="right", focal=focal, size=capture.info.width, fit=fit)
    return read_source(keep / f"{clip}.avi", _landmarks(clip, keep), options), options


def _landmarks(clip: str, keep: Path) -> Path:
    return keep / f"landmarks{clip.removeprefix('clip')}.npz"


def _write_video(capture: Capture, file: Path) -> None:
    writer = cv2.VideoWriter(str(file), cv2.VideoWriter.fourcc(*"MJPG"), FPS, (SIZE, SIZE))
    for frame in range(FRAMES):
        writer.write(np.ascontiguousarray(capture.frame(frame)[:, :, ::-1]))
    writer.release()


def _drawn(
    errors: LandmarkErrors, grown: np.ndarray, rng: np.random.Generator
) -> tuple[np.ndarray, np.ndarray]:
    """Errors with the covariance, growth and memory of the measured ones, for other frames."""
    flat = (
        np.concatenate([errors.image.reshape(-1, 42), errors.world.reshape(-1, 63)], axis=1)
        / errors.grown[:, None]
    )
    half = np.linalg.cholesky(np.cov(flat.T) + 1e-12 * np.eye(flat.shape[1]))
    walk = np.empty((len(grown), flat.shape[1]))
    walk[0] = half @ rng.normal(size=flat.shape[1])
    for frame in range(1, len(walk)):
        new = half @ rng.normal(size=flat.shape[1])
        walk[frame] = errors.memory * walk[frame - 1] + np.sqrt(1.0 - errors.memory**2) * new
    walk *= grown[:, None]
    return walk[:, :42].reshape(-1, 21, 2), walk[:, 42:].reshape(-1, 21, 3)


def scene_text(clip: str, seed: int, kind: ClipKind) -> str:
    """The scene of a clip, as a scene file says it."""
    keys = ",\n".join(
        f'{{ gesture = "{name}", turn = {turn}.0, tilt = {tilt}.0, roll = {roll}.0 }}'
        for name, turn, tilt, roll in _KEYS
    )
    return f"""
id = "{clip}"
title = "A clip for the importer"
hands = "right"
action = "Multiple gestures"
device = "Phone"
frame_count = {FRAMES}
fps = {FPS}
seed = {seed}
background = "office"
noise = 0.01
[subject]
seed = {seed}
tone = {0.2 + 0.15 * (seed % 3):.2f}
age = 35.0
[subject.anatomy]
{kind.anatomy}
[camera]
handheld = false
field_of_view = 28.0
[light]
direction = [-0.5, -0.9, -0.8]
key = {kind.key}
sky = {kind.sky}
kelvin = 5200.0
[track]
period = 7.0
variation = 8.0
right = [
{keys}
]
"""
