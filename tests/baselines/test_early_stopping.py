"""Every baseline ends with the state that draws validation frames best.

Training frames are made dark after the fit has started from their colour, so that each step takes a
fit away from the validation frames. Oracle: the states of the fit, put back and drawn one by one,
and the rule written out.
"""

from __future__ import annotations

import importlib
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from painted import SilentReport, TrainingMaker
from scipy.ndimage import binary_erosion

from hwp_bench.base.errors import BadMethod
from hwp_bench.capture.splits import Split
from hwp_bench.methods import MethodManifest, read_manifest
from hwp_bench.methods.contract import Avatar, Budget, TrainingCapture
from hwp_bench.methods.settings import settings_from
from wildghand.fitting.method import NetworkMethod
from wildghand.gaussians.training import load_frames
from wildghand.model.settings import read_settings
from wildghand.plain.loop import run_fit
from wildghand.plain.recipe import FitInputs, PlainRecipe, Recipe, RecipeMethod

CPU = torch.device("cpu")
BASELINES = Path(__file__).resolve().parents[2] / "baselines"
MANIFESTS = [read_manifest(file.parent) for file in sorted(BASELINES.glob("*/method.toml"))]
#: Of two training frames: states are kept after 5, 10 and 20 steps.
QUICK = {"gaussians": 300, "steps": 40, "batch": 1, "device": "cpu"}


def entry_of(manifest: MethodManifest) -> Any:
    module, _, name = str(manifest.entry.python).partition(":")
    return getattr(importlib.import_module(module), name)


RECIPES = {
    manifest.name: entry_of(manifest)
    for manifest in MANIFESTS
    if issubclass(entry_of(manifest), RecipeMethod)
}


@pytest.fixture
def training(make_training: TrainingMaker) -> TrainingCapture:
    """Two frames are fitted, four are for validation."""
    made = make_training()
    first, last = made.split.test[[0, -1]].tolist()
    made.split = Split(made.id, last + 1, (0, 2), (first - 4, first), (first, last + 1))
    made._train = made.split.train
    return made


def misled(
    training: TrainingCapture, kind: type[RecipeMethod], **changes: Any
) -> tuple[Recipe[Any], Avatar, dict[int, dict[str, torch.Tensor]]]:
    """A fit whose frames darken after it began, its avatar, and the means of its steps."""
    settings = settings_from(kind.settings_type, {**QUICK, **changes}, "here")
    recipe = kind.recipe_type(FitInputs(training, load_frames(training), 0, CPU), settings)
    recipe.material.frames.images.floor_divide_(4)
    means: dict[int, dict[str, torch.Tensor]] = {}

    def watch(step: int, watchers: object, loss: object) -> None:
        with recipe.average.in_place():
            means[step] = recipe.snapshot()

    return recipe, run_fit(recipe, Budget(), SilentReport(), after_step=watch), means


def error_of(avatar: Avatar, training: TrainingCapture) -> float:
    """Mean squared error of the validation frames within the masks, less a pixel at the border."""
    squares: list[np.ndarray] = []
    for frame in training.validation.tolist():
        drawn = avatar.render(training.hand_poses(frame), training.camera(frame))[..., :3]
        off = np.square(drawn - training.frame(frame) / 255.0).mean(axis=-1)
        squares.append(off[binary_erosion(training.mask(frame) > 127, np.ones((3, 3)))])
    return float(np.concatenate(squares).mean())


@pytest.mark.parametrize("name", RECIPES)
def test_the_state_of_the_lower_validation_error_is_kept(
    name: str, training: TrainingCapture, capsys: pytest.CaptureFixture[str]
) -> None:
    changes = {
        # The shadows of its preset learn darkness faster than its colours.
        "scan-texture": {"shadow_rate": 3e-3},
        # Only D-SSIM compares the colours that it keeps.
        "wild": {"dssim_weight": 0.2},
    }
    recipe, avatar, means = misled(training, RECIPES[name], **changes.get(name, {}))
    kept = recipe.snapshot()
    found = error_of(avatar, training)
    errors = {}
    for step in (40, 20, 10, 5):
        recipe.restore(means[step])
        errors[step] = error_of(recipe.avatar(step), training)
    best = next((s for s in (40, 20, 10) if errors[s // 2] >= errors[s]), 5)
    # The dark frames mislead all of them.
    assert best < 40
    assert found == pytest.approx(errors[best], rel=1e-6)
    assert all(torch.equal(value, means[best][key]) for key, value in kept.items())
    assert f"The state of step {best} draws the validation frames best" in capsys.readouterr().err


def test_without_the_choice_a_fit_ends_with_its_last_step(training: TrainingCapture) -> None:
    recipe, _, means = misled(training, RECIPES["plain"], validated=False)
    for name, value in recipe.snapshot().items():
        assert torch.equal(value, means[40][name])
    settings = settings_from(RECIPES["plain"].settings_type, {**QUICK, "validated": False}, "here")
    again = PlainRecipe(FitInputs(training, load_frames(training), 0, CPU), settings)
    again.material.frames.images.floor_divide_(4)
    order = again.batches()
    for step in range(40):
        again.step(next(order), step / 40)
    assert all(torch.equal(recipe.snapshot()[n], v) for n, v in again.snapshot().items())


def test_with_too_few_validation_frames_it_is_the_mean_of_the_last_steps(
    training: TrainingCapture,
) -> None:
    first, last = training.split.test[[0, -1]].tolist()
    training.split = Split(training.id, last + 1, (0, 2), (first - 3, first), (first, last + 1))
    recipe, _, means = misled(training, RECIPES["plain"])
    assert all(torch.equal(value, means[40][name]) for name, value in recipe.snapshot().items())


@pytest.mark.parametrize(
    "changes",
    [
        {"prior": "shipped"},
        {"mode": "default"},
        {"prepass.enabled": True},
        {"subject.enabled": True},
        {"visibility.enabled": True},
    ],
    ids=str,
)
def test_the_network_alone_refuses_what_it_does_not_declare(changes: dict[str, Any]) -> None:
    manifest = next(one for one in MANIFESTS if one.name == "network-scratch")
    for preset in manifest.presets.values():
        NetworkMethod({**preset, "device": "cpu"})
    with pytest.raises(BadMethod, match="network-scratch"):
        NetworkMethod({**manifest.presets["smoke"], "device": "cpu", **changes})


@pytest.mark.parametrize("manifest", MANIFESTS, ids=lambda manifest: manifest.name)
def test_it_is_on_by_default_and_declared(manifest: MethodManifest) -> None:
    assert "earlier-state" in (manifest.validation or [])
    for name, preset in manifest.presets.items():
        if manifest.name in RECIPES:
            kind = RECIPES[manifest.name].settings_type
            assert settings_from(kind, preset, manifest.name).validated, name
        elif preset["mode"] != "paper":  # as published
            assert read_settings(preset).schedule.validated, name
