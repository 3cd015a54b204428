"""Baselines on a device that is not the CPU. Oracle: a stand-in for CUDA that refuses what it does.

See `other_device`: no operation takes tensors of two devices, and numpy takes none of them.
"""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from fitted_parts import material_of
from other_device import other_device
from painted import SilentReport, TrainingMaker
from test_early_stopping import RECIPES

from hwp_bench.methods.contract import Budget
from hwp_bench.methods.settings import settings_from
from wildghand.gaussians.training import TrainingFrames
from wildghand.plain.loop import run_fit

QUICK = {"gaussians": 60, "steps": 2, "batch": 2, "device": "cpu"}


@pytest.mark.filterwarnings("ignore:for .* copying from a non-meta parameter")
@pytest.mark.parametrize("name", RECIPES)
def test_a_fit_and_its_avatar_stay_on_the_device(
    name: str, make_training: TrainingMaker, monkeypatch: pytest.MonkeyPatch
) -> None:
    training, kind = make_training("right"), RECIPES[name]
    material, settings = material_of(training), settings_from(kind.settings_type, QUICK, name)
    frames = material.frames
    few = TrainingFrames(frames.indices[:2], frames.images[:2], frames.masks[:2])
    frame = int(training.targets[0])
    with other_device(monkeypatch) as device:
        material = dataclasses.replace(material, frames=few, device=device)
        avatar = run_fit(kind.recipe_type(material, settings), Budget(), SilentReport())
        image = avatar.render(training.hand_poses(frame), training.camera(frame))
    assert np.isfinite(image).all()
    assert image[..., 3].max() > 0.5
