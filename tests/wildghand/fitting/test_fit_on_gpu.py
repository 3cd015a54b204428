"""Whole fits on a GPU. Oracles: the same fit on the CPU, and the avatar before it was written.

Tolerances: a score within 0.5 dB of the CPU's, because float32 sums in another order lead a fit
elsewhere; pictures of one avatar within one grey level in 99 of 100 numbers.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from painted import QUICK as SMALL
from painted import SilentReport, TrainingMaker
from tiny_fits import QUICK

from hwp_bench.methods.contract import Budget, TrainingCapture
from plain_fit.method import PlainMethod
from scan_texture_fit.method import ScanMethod
from texture_space_fit.method import SpaceMethod
from wildghand.avatar.avatar import WildGHandAvatar
from wildghand.avatar.files import load_avatar, save_avatar
from wildghand.fitting.components import make_fit
from wildghand.fitting.fit import Fit
from wildghand.fitting.method import WildGHandMethod
from wildghand.fitting.session import load_state, save_state
from wildghand.gaussians.fit_loop import choose_device, ready_device
from wildghand.model.settings import read_settings
from wildghand.plain.loop import Watchers, run_fit
from wildghand.plain.recipe import RecipeMethod

HAS_GPU = choose_device("auto").type == "cuda"
pytestmark = pytest.mark.skipif(not HAS_GPU, reason="needs a GPU and gsplat")

STEPS = 60
VARIANTS: dict[str, dict[str, Any]] = {
    "default": {},
    "two hands": {},
    "paper": {"mode": "paper", "schedule.epochs": 0},
    "released": {"mode": "released", "schedule.epochs": 0},
    "batch of 4": {"schedule.batch": 4},
    "mixed precision": {"mixed_precision": True},
}


def settings_of(name: str, device: str) -> dict[str, Any]:
    return {**QUICK, "schedule.steps": STEPS, **VARIANTS[name], "device": device}


def training_of(name: str, make_training: TrainingMaker) -> TrainingCapture:
    return make_training("both" if name == "two hands" else "right")


def drawn(avatar: Any, training: TrainingCapture, frame: int) -> np.ndarray:
    picture = avatar.render(training.hand_poses(frame), training.camera(frame))
    return np.asarray(picture, dtype=float)[..., :3]


def psnr(avatar: Any, training: TrainingCapture) -> float:
    """Over the hand in the validation frames, dB."""
    errors = []
    for frame in training.validation.tolist():
        away = drawn(avatar, training, frame) - training.frame(frame) / 255.0
        errors.append(np.square(away)[training.mask(frame) > 127].mean())
    return float(-10.0 * np.log10(np.mean(errors)))


@pytest.mark.parametrize("name", VARIANTS)
def test_a_fit_scores_as_on_the_cpu_and_its_avatar_is_drawn_there(
    name: str, make_training: TrainingMaker, tmp_path: Path
) -> None:
    training = training_of(name, make_training)
    made: dict[str, WildGHandAvatar] = {}
    for device in ("cpu", "cuda"):
        method = WildGHandMethod(settings_of(name, device), 0)
        made[device] = method.fit(training, Budget(), SilentReport())
    assert psnr(made["cuda"], training) == pytest.approx(psnr(made["cpu"], training), abs=0.5)
    masks = made["cuda"].weight_masks
    assert set(masks) == set(made["cpu"].weight_masks)
    assert all(np.isfinite(mask).all() for mask in masks.values())
    save_avatar(made["cuda"], tmp_path / "avatar")
    read = load_avatar(tmp_path / "avatar")
    frame = int(training.validation[0])
    away = np.abs(drawn(read, training, frame) - drawn(made["cuda"], training, frame))
    assert np.quantile(away, 0.99) < 1.0 / 255.0


def test_a_stopped_fit_goes_on(make_training: TrainingMaker, tmp_path: Path) -> None:
    training, file = make_training("right"), tmp_path / "state.pt"
    settings = read_settings(settings_of("default", "cuda"))

    def fit() -> Fit:
        return make_fit(training, settings, 0, ready_device("cuda"))

    stopped, again = fit(), fit()

    def save(step: int, watchers: Watchers, loss: object) -> None:
        if step == STEPS // 2:
            save_state(file, stopped, watchers, step=step, seconds=1.0, digest="d")

    whole = run_fit(stopped, Budget(), SilentReport(), after_step=save)
    watchers = Watchers()
    start, _ = load_state(file, again, watchers, "d")
    finished = run_fit(again, Budget(), SilentReport(), start=start, watchers=watchers)
    assert finished.steps == STEPS
    # Kernels add in any order, so that not even two runs from one state have the same bits.
    assert psnr(finished, training) == pytest.approx(psnr(whole, training), abs=0.5)


@pytest.mark.parametrize("hands", ["right", "both"])
@pytest.mark.parametrize("kind", [PlainMethod, ScanMethod, SpaceMethod])
def test_a_baseline_scores_as_on_the_cpu(
    kind: type[RecipeMethod], hands: str, make_training: TrainingMaker
) -> None:
    training = make_training(hands)
    scores = [
        psnr(kind({**SMALL, "device": device}, 0).fit(training, Budget(), SilentReport()), training)
        for device in ("cpu", "cuda")
    ]
    assert scores[1] == pytest.approx(scores[0], abs=0.5)
