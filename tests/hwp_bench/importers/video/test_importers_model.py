"""Derivatives of pixels. Oracle: central differences of the model, and of scipy's rotations."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from synthetic_clip import FOCAL, HEIGHT, WIDTH, make_clip, with_correctives

from hwp_bench.importers.video.model import (
    FRAME_VARIABLES,
    ClipModel,
    SurfaceMotion,
    join_frames,
    pose_vertices,
    rigid_start,
    split_frames,
)

CENTRE = np.array([WIDTH / 2, HEIGHT / 2])


def bent_model(*, correctives: bool = False) -> ClipModel:
    """Three frames with every variable away from zero."""
    clip = make_clip(3)
    hand = with_correctives(clip.template) if correctives else clip.template
    start = rigid_start(clip.landmarks, hand_landmarks(clip.joints), FOCAL, CENTRE)
    model = ClipModel(hand, start, FOCAL, CENTRE)
    generator = torch.Generator().manual_seed(0)
    with torch.no_grad():
        for name, size in (("turn", 0.3), ("fingers", 0.3), ("anchor", 0.05), ("betas", 0.5)):
            value = getattr(model.variables, name)
            value += size * torch.randn(value.shape, generator=generator)
    return model


def hand_landmarks(joints: np.ndarray) -> np.ndarray:
    return np.asarray(joints[0] - joints[0, 0])


def pixels_at(model: ClipModel, values: np.ndarray) -> np.ndarray:
    with torch.no_grad():
        for name, part in split_frames(values).items():
            getattr(model.variables, name).copy_(torch.as_tensor(part))
        return np.asarray(model.pixels(torch.as_tensor(pose_vertices(model))).double().numpy())


@pytest.mark.parametrize("correctives", [False, True])
def test_pixels_move_as_the_derivatives_say(correctives: bool) -> None:
    # Steps of 0.004 in float32: differences are exact to about 0.02 px per unit, derivatives are
    # up to 300. How correctives change with the fingers is left out on purpose.
    model = bent_model(correctives=correctives)
    some = np.arange(0, len(model.template.vertices), 40)
    motion = SurfaceMotion(model)
    found = np.stack([motion.by_variables(frame, some) for frame in range(3)])
    start = join_frames(model.variables.read())
    columns = range(FRAME_VARIABLES) if not correctives else (0, 1, 2, 48, 49, 50)
    for column in columns:
        step = np.zeros(FRAME_VARIABLES)
        step[column] = 0.004
        ahead, behind = pixels_at(model, start + step), pixels_at(model, start - step)
        expected = (ahead - behind)[:, some] / 0.008
        np.testing.assert_allclose(found[..., column], expected, atol=0.1)
