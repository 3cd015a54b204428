"""Small captures and results for tests; they need no simulator."""

from __future__ import annotations

import functools
import json
from collections.abc import Callable
from pathlib import Path

import numpy as np

from hwp_bench.base.files import sha256_json
from hwp_bench.capture import Cameras, Capture, HandModelId, identify_hand_model
from hwp_bench.hands.skeleton import HandParameters
from hwp_bench.results import (
    CaptureResult,
    CurvePoint,
    FrameResult,
    MethodId,
    Results,
    TrainingData,
)

CaptureMaker = Callable[..., Capture]


@functools.cache
def free_hand(hands: str) -> HandModelId:
    """What a capture of the free hand says of its model."""
    return identify_hand_model("anny", hands)


def hand_parameters(frames: int, seed: int = 0) -> HandParameters:
    """A hand half a metre in front of the camera that moves a little."""
    rng = np.random.default_rng(seed)
    transl = np.zeros((frames, 3))
    transl[:, 0] = np.linspace(-0.01, 0.01, frames)
    transl[:, 2] = 0.5
    return HandParameters(
        pose=rng.normal(0, 0.1, (frames, 16, 3)),
        betas=rng.normal(0, 1, 10),
        transl=transl,
        valid=np.ones(frames, dtype=bool),
    )


def cameras(frames: int, size: int) -> Cameras:
    """A camera at the origin that sees about 60 degrees."""
    K = np.array([[size * 0.9, 0, size / 2], [0, size * 0.9, size / 2], [0, 0, 1.0]])
    return Cameras(np.repeat(K[None], frames, 0), np.repeat(np.eye(4)[None], frames, 0))


def hand_picture(frame: int, size: int, seed: int = 0) -> tuple[np.ndarray, np.ndarray]:
    """A textured disc that moves to the right over a textured background, and its mask."""
    rng = np.random.default_rng(seed)
    rows, columns = np.mgrid[:size, :size]
    centre = size * 0.4 + frame * 0.25
    inside = (rows - size / 2) ** 2 + (columns - centre) ** 2 < (size * 0.3) ** 2
    background = rng.integers(0, 60, (size, size, 3))
    waves = 60 * np.sin(columns / 3.0 + frame * 0.1) + 20 * np.sin(rows / 2.0)
    texture = np.clip(150 + waves, 0, 255)
    skin = np.stack([texture, texture * 0.8, texture * 0.7], axis=2)
    picture = np.where(inside[:, :, None], skin, background).astype(np.uint8)
    return picture, (inside * 255).astype(np.uint8)


def split_file(path: Path, capture: str, train: list[int], frames: int) -> str:
    """Write a split of one capture that trains on few frames; returns its path."""
    content = {
        "capture": capture,
        "frame_count": frames,
        "train": train,
        "validation": [frames - 3, frames - 2],
        "test": [frames - 2, frames],
    }
    split = {**content, "digest": sha256_json(content)}
    path.write_text(json.dumps({"schema": "hwp-splits/1", "splits": [split]}))
    return str(path)


def results_example(name: str = "plain", psnr: float = 20.0, digest: str = "d") -> Results:
    """One method on one capture of two test frames."""
    frames = [FrameResult(18 + i, {"psnr": psnr + i, "ssim": 0.5}, None) for i in range(2)]
    capture = CaptureResult(
        id="capture2",
        digest=digest,
        hands="right",
        perturbations=["illumination"],
        split_digest="s",
        exact_masks=True,
        key="k",
        frames=frames,
        failure=None,
        predictions_digest="p",
        fit_seconds=2.0,
        render_seconds=0.5,
        score_seconds=0.1,
        wall_seconds=4.0,
        steps=10,
        peak_memory=10**8,
        device="cpu",
        curve=[CurvePoint(5, 1.0, 10**8, {"psnr": 15.0})],
    )
    return Results(
        method=MethodId(name, name.title(), "m", "default", {"steps": 10}, TrainingData()),
        suite="smoke",
        seed=0,
        budget={"seconds": None, "steps": None},
        frames="perturbed",
        protocols={},
        environment={},
        started="2026-01-01T00:00:00+00:00",
        captures=[capture],
        toolkit="0.1.0",
    )
