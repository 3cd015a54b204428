"""Clips on which a tracker's errors can be measured: a real one without truth, simulated ones with.

Of a real clip the landmarks' distances from the importer's fit are known. Simulated clips get true
landmarks with errors of the same covariance, growth and memory, and pass the same importer: there
the errors of the parameters are known.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
import torch

from hwp_bench.hands import load_template, pose_hand
from hwp_bench.hands.parameters import HandParameters
from hwp_bench.importers.video import VideoImport
from hwp_bench.importers.video.from_video import fit_video, read_source
from hwp_bench.sim.produce.production import render_capture
from hwp_bench.sim.produce.tracker_geometry import curl, edge_on
from hwp_bench.sim.scene.reader import parse_scene

#: Frames, rate and size of a simulated clip.
FRAMES, FPS, SIZE = 240, 30.0, 256
#: Share of the frames with the smallest errors that says how large errors are in easy frames.
EASY = 0.05
_KEYS = (
    ("open", 180, 0, 0),
    ("fist", 170, 0, 0),
    ("point", 200, 10, 0),
    ("open", 250, 0, 0),
    ("pinch", 165, 0, 0),
    ("fist", 230, 0, 0),
    ("victory", 150, 0, 15),
)


@dataclass(frozen=True, eq=False)
class RealClip:
    """A real clip and the importer's fit to it."""

    #: (F, 21, 2) px and (F, 21, 3) m of the tracker.
    image: np.ndarray
    world: np.ndarray
    #: (F, 21, 2) px and (F, 21, 3) m, camera axes, of the fit, with the tracker's offsets.
    fitted_image: np.ndarray
    fitted: np.ndarray
    #: (F, 16, 3) axis-angle rad of the fit.
    pose: np.ndarray


@dataclass(frozen=True, eq=False)
class LandmarkErrors:
    """How a tracker's landmarks err."""

    #: (F, 21, 2) shares of the hand's extent and (F, 21, 3) m, less the mean of the clip.
    image: np.ndarray
    world: np.ndarray
    #: Size of the errors against the clip's mean: at rest, per curl, per edge-on view.
    growth: tuple[float, float, float]
    #: (F,) of each frame.
    grown: np.ndarray
    #: Correlation of two frames that follow each other, of the errors over their growth: the
    #: median of all numbers.
    memory: float


@dataclass(frozen=True, eq=False)
class RoundTrip:
    """Parameters that came out of the importer, and the true ones; the camera is at the origin."""

    #: As estimated.
    estimate: HandParameters
    #: As rendered.
    truth: HandParameters


def real_clip(video: Path, landmarks: Path, keep: Path) -> RealClip:
    """Fit the hand of a real clip; the fit is kept in a folder and read from there."""
    file = keep / "real.npz"
    if not file.exists():
        options = VideoImport(side="right")
        clip = fit_video(read_source(video, landmarks, options), options)
        model, source = clip.first.fitted.model, clip.source.landmarks
        with torch.no_grad():
            posed = model.posed()
            pixels = model.pixels(posed.landmarks).numpy()
        arrays = (
            source.image,
            source.world,
            pixels,
            posed.landmarks.numpy(),
            clip.first.parameters.pose,
        )
        np.savez(file, *[np.asarray(array, dtype=np.float64) for array in arrays])
    with np.load(file) as stored:
        return RealClip(*(stored[f"arr_{index}"] for index in range(5)))


def landmark_errors(clip: RealClip) -> LandmarkErrors:
    """Distances of a clip's landmarks from its fit."""
    boxes = clip.image.max(axis=1) - clip.image.min(axis=1)
    extent = float(np.median(boxes.max(axis=1)))
    image = (clip.image - clip.fitted_image) / extent
    fitted = clip.fitted - clip.fitted.mean(axis=1, keepdims=True)
    tracked = clip.world - clip.world.mean(axis=1, keepdims=True)
    # The tracker's metres have a scale of their own.
    world = tracked * float((fitted * tracked).sum() / np.square(tracked).sum()) - fitted
    image, world = image - image.mean(axis=0), world - world.mean(axis=0)
    size = np.sqrt(np.square(image).sum(axis=2).mean(axis=1))
    hard = np.stack([curl(clip.pose), edge_on(clip.fitted)], axis=1)
    from scipy.optimize import nnls

    still = float(np.quantile(size, EASY))
    more = nnls(hard, size - still)[0]
    grown = still + hard @ more
    mean = float(grown.mean())
    both = np.concatenate([image.reshape(-1, 42), world.reshape(-1, 63)], axis=1)
    normal = both / grown[:, None]
    memory = (normal[1:] * normal[:-1]).sum(axis=0) / np.square(normal).sum(axis=0)
    growth = (still / mean, float(more[0]) / mean, float(more[1]) / mean)
    return LandmarkErrors(image, world, growth, grown / mean, float(np.median(memory)))


def round_trip(seed: int, errors: LandmarkErrors, keep: Path) -> RoundTrip:
    """Render a clip, track it with errors, import it; kept in a folder and read from there."""
    file = keep / f"clip{seed}.npz"
    if not file.exists():
        _import_simulated(seed, errors, keep, file)
    with np.load(file) as stored:
        estimate, truth = (
            HandParameters(*(stored[f"{name}_{part}"] for part in _PARTS))
            for name in ("estimate", "truth")
        )
    return RoundTrip(estimate, truth)


_PARTS = ("pose", "betas", "transl", "valid")


def _import_simulated(seed: int, errors: LandmarkErrors, keep: Path, file: Path) -> None:
    scene = parse_scene(_scene(seed), where=f"clip{seed}")
    capture = render_capture(
        scene, keep / f"clip{seed}", size=SIZE, workers=1, overwrite=True, free_view=False
    )
    truth = (capture.true_hands or {})["right"]
    posed = pose_hand(
        load_template(side="right").to_torch(torch.float64),
        *(torch.from_numpy(array) for array in (truth.pose, truth.betas, truth.transl)),
    )
    points = posed.landmarks.numpy()
    K = capture.cameras.Ks[0]
    pixels = (points / points[..., 2:]) @ K.T
    boxes = pixels[..., :2].max(axis=1) - pixels[..., :2].min(axis=1)
    still, bent, turned = errors.growth
    grown = still + bent * curl(truth.pose) + turned * edge_on(points)
    image, world = _drawn(errors, grown, np.random.default_rng(seed))
    image *= float(np.median(boxes.max(axis=1)))
    video, landmarks = keep / f"clip{seed}.avi", keep / f"landmarks{seed}.npz"
    writer = cv2.VideoWriter(str(video), cv2.VideoWriter.fourcc(*"MJPG"), FPS, (SIZE, SIZE))
    for frame in range(FRAMES):
        writer.write(np.ascontiguousarray(capture.frame(frame)[:, :, ::-1]))
    writer.release()
    centred = points - points.mean(axis=1, keepdims=True)
    np.savez(landmarks, image=pixels[..., :2] + image, world=centred + world, score=np.ones(FRAMES))
    options = VideoImport(side="right", focal=float(K[0, 0]), size=SIZE)
    hand = fit_video(read_source(video, landmarks, options), options).first.parameters
    np.savez(
        file,
        **{f"estimate_{part}": getattr(hand, part) for part in _PARTS},
        **{f"truth_{part}": getattr(truth, part) for part in _PARTS},
    )


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


def _scene(seed: int) -> str:
    keys = ",\n".join(
        f'{{ gesture = "{name}", turn = {turn}.0, tilt = {tilt}.0, roll = {roll}.0 }}'
        for name, turn, tilt, roll in _KEYS
    )
    return f"""
id = "clip{seed}"
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
[camera]
handheld = false
field_of_view = 28.0
[light]
direction = [-0.5, -0.9, -0.8]
key = 0.6
sky = 0.35
kelvin = 5200.0
[track]
period = 7.0
variation = 8.0
right = [
{keys}
]
"""
