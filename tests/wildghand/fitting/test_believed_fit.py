"""A fit in the poses that it believes in. Oracles: the same hands given at once, and the file.

The painted capture has fewer frames than a hand has angles, so that nothing is told of its errors;
what is believed here is put in by hand.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pygltflib
import pytest
import torch
from painted import SilentReport, TrainingMaker
from tiny_fits import QUICK, UNJUDGED

from hwp_bench.capture import Capture
from hwp_bench.hands import HandParameters
from hwp_bench.methods.contract import Budget, TrainingCapture
from hwp_bench.methods.request import frame_choice
from wildghand.avatar.avatar import WildGHandAvatar
from wildghand.avatar.files import load_avatar, save_avatar
from wildghand.export.formats import ExportSettings, export
from wildghand.fitting import start
from wildghand.fitting.components import make_fit
from wildghand.fitting.method import WildGHandMethod
from wildghand.model import terms
from wildghand.model.settings import read_settings
from wildghand.page.write import PageSettings, sample_poses
from wildghand.poses import ClipPoses
from wildghand.viewer.posed_view import Motion


def _bent(hands: dict[str, HandParameters]) -> dict[str, HandParameters]:
    """The hands with the fingers a little more bent, nearer to the camera."""
    return {
        side: dataclasses.replace(hand, pose=hand.pose + 0.05, transl=hand.transl * 0.98)
        for side, hand in hands.items()
    }


@pytest.fixture
def believing(monkeypatch: pytest.MonkeyPatch) -> None:
    """Fits believe in bent fingers."""
    monkeypatch.setattr(start, "believed_hands", lambda templates, hands, *_: _bent(hands))


def _fitted(training: TrainingCapture, **changes: object) -> WildGHandAvatar:
    method = WildGHandMethod({**QUICK, "schedule.steps": 4, **changes}, 0)
    return method.fit(training, Budget(), SilentReport())


@pytest.mark.usefixtures("believing")
def test_a_fit_is_that_of_a_capture_with_the_believed_poses(
    make_training: TrainingMaker, monkeypatch: pytest.MonkeyPatch
) -> None:
    training = make_training("both")
    # Where poses are believed, D-SSIM has another share, and thickness of Gaussians costs.
    monkeypatch.setattr(terms, "SURFACE_INEXACT", 0.0)
    avatar = _fitted(training)
    bent = training.with_hands(_bent(training.hands))
    told = _fitted(bent, **{"poses.enabled": False, "terms.dssim_weight": 0.05})
    frame = int(training.targets[0])
    camera = training.camera(frame)
    drawn = avatar.render(training.hand_poses(frame), camera)
    # The avatar's table is of float32.
    np.testing.assert_allclose(drawn, told.render(bent.hand_poses(frame), camera), atol=1e-3)
    given = told.render(training.hand_poses(frame), camera)
    assert np.abs(drawn - given).max() > 0.1
    # Other poses are drawn as they are.
    other = bent.hand_poses(frame)
    np.testing.assert_array_equal(avatar.render(other, camera), told.render(other, camera))
    monkeypatch.setattr(terms, "SURFACE_INEXACT", 100.0)
    flatter = _fitted(training)
    assert np.abs(drawn - flatter.render(training.hand_poses(frame), camera)).max() > 1e-3


@pytest.mark.usefixtures("believing")
def test_an_avatar_keeps_what_it_believes_in_its_file(
    make_training: TrainingMaker, tmp_path: Path
) -> None:
    training = make_training("right")
    avatar = _fitted(training)
    save_avatar(avatar, tmp_path / "avatar")
    read = load_avatar(tmp_path / "avatar")
    where = training.hand_poses(3), training.camera(3)
    np.testing.assert_array_equal(avatar.render(*where), read.render(*where))
    assert read.model.clip_poses is not None


@pytest.mark.parametrize("name", ["poses", "test-poses"])
def test_a_fit_says_in_which_frames_an_error_budget_gives_true_poses(
    name: str, make_training: TrainingMaker, monkeypatch: pytest.MonkeyPatch
) -> None:
    training = make_training("right")
    training.run = dataclasses.replace(training.run, frames=frame_choice([name]))
    told: list[np.ndarray] = []

    def believed(templates: object, hands: object, cameras: object, exact: np.ndarray) -> object:
        told.append(np.flatnonzero(exact))
        return hands

    monkeypatch.setattr(start, "believed_hands", believed)
    make_fit(training, read_settings(UNJUDGED), 0, torch.device("cpu"))
    others = [*training.validation, *training.targets]
    assert [*told[0]] == [*(training.split.train if name == "poses" else others)]


def test_the_loss_goes_by_the_poses_of_the_fitted_frames(
    make_training: TrainingMaker, monkeypatch: pytest.MonkeyPatch
) -> None:
    """As in an error budget that gives the true poses of the training frames alone."""
    training = make_training("right")
    rows, shares, honest = training.train, [], terms.reconstruction

    def bend(templates: object, hands: dict[str, HandParameters], *_: object) -> object:
        bent = _bent(hands)
        for side, hand in bent.items():
            hand.pose[rows], hand.transl[rows] = hands[side].pose[rows], hands[side].transl[rows]
        return bent

    def watched(*given: Any) -> torch.Tensor:
        shares.append(given[3])
        return honest(*given)

    monkeypatch.setattr(start, "believed_hands", bend)
    monkeypatch.setattr(terms, "reconstruction", watched)
    assert _fitted(training).model.clip_poses is not None
    assert set(shares) == {0.2}


def test_clips_that_tell_nothing_are_fitted_as_they_are_given(make_training: TrainingMaker) -> None:
    training = make_training("right")
    avatar = _fitted(training)
    assert avatar.model.clip_poses is None
    off = _fitted(training, **{"poses.enabled": False})
    where = training.hand_poses(3), training.camera(3)
    np.testing.assert_array_equal(avatar.render(*where), off.render(*where))


def test_motion_and_pages_play_what_is_believed(
    tiny_avatar: WildGHandAvatar, make_painted: Callable[..., Capture], tmp_path: Path
) -> None:
    capture = make_painted()
    before = sample_poses(tiny_avatar, capture, PageSettings())
    poses = ClipPoses.of(capture.hands, _bent(capture.hands))
    assert poses is not None
    tiny_avatar.model.clip_poses = poses
    try:
        frame = tiny_avatar.record.frames[0]
        bent = capture.hand_poses(frame)["right"].pose + 0.05
        shown = Motion(tiny_avatar, capture).hands(frame)["right"]
        np.testing.assert_allclose(shown.pose, bent, atol=1e-6)
        samples = sample_poses(tiny_avatar, capture, PageSettings())
        moved = samples.motion["right"][:, :48] - before.motion["right"][:, :48]
        np.testing.assert_allclose(moved, 0.05, atol=1e-6)
        path = tmp_path / "hand.glb"
        export(tiny_avatar, path, ExportSettings(mesh=True), capture=capture)
        played = _first_quaternion(path)
    finally:
        tiny_avatar.model.clip_poses = None
    export(tiny_avatar, path, ExportSettings(mesh=True), capture=capture, overwrite=True)
    assert np.abs(played - _first_quaternion(path)).max() > 0.01


def _first_quaternion(path: Path) -> np.ndarray:
    """The last joint's first rotation in a file."""
    made = pygltflib.GLTF2().load(str(path))
    moving = [
        made.animations[0].samplers[channel.sampler].output
        for channel in made.animations[0].channels
        if channel.target.path == "rotation"
    ]
    data = made.accessors[moving[-1]]
    view = made.bufferViews[data.bufferView]
    start = (view.byteOffset or 0) + (data.byteOffset or 0)
    return np.frombuffer(made.binary_blob(), "<f4", 4, start)
