"""A fit that is watched. Oracles: the same fit that nobody watches, a clock that a test turns."""

from __future__ import annotations

import dataclasses
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from painted import SilentReport, TrainingMaker
from scipy.spatial.transform import Rotation
from tiny_fits import UNJUDGED

from hwp_bench.capture import Capture
from hwp_bench.methods.contract import Budget
from wildghand.cli.main import main
from wildghand.fitting import fit_capture
from wildghand.fitting.components import make_fit
from wildghand.fitting.fit import Fit
from wildghand.fitting.glance import Glance, Live, glance
from wildghand.fitting.session import Watch
from wildghand.gaussians.fit_loop import Loss
from wildghand.model.settings import read_settings
from wildghand.plain.loop import Watchers, run_fit

QUICK: dict[str, Any] = {**UNJUDGED, "gaussians": 400}


@pytest.mark.parametrize("changes", [{}, {"mode": "paper", "schedule.epochs": 0}], ids=str)
def test_a_watched_fit_gives_the_same_bits(
    changes: dict[str, Any], make_training: TrainingMaker
) -> None:
    training = make_training()
    settings = read_settings({**QUICK, "schedule.steps": 10, **changes})
    seen: list[Glance] = []

    def fitted(watch: Watch) -> dict[str, torch.Tensor]:
        fit = make_fit(training, settings, 0, torch.device("cpu"))

        def look(step: int, watchers: Watchers, loss: Loss) -> None:
            watch(fit, step, loss)

        return run_fit(fit, Budget(), SilentReport(), after_step=look).model.state_dict()

    expected = fitted(lambda fit, step, loss: None)
    found = fitted(Live(seen.append, row=lambda count: len(seen) % count, pause=0.0))
    assert expected.keys() == found.keys()
    assert all(torch.equal(expected[name], found[name]) for name in expected)
    assert [look.step for look in seen] == list(range(1, 11))
    assert len({look.frame for look in seen}) == 10


def test_a_glance_shows_the_frame_the_avatar_and_the_weights(make_training: TrainingMaker) -> None:
    training = make_training()
    settings = read_settings({**QUICK, "schedule.steps": 60})
    fit = make_fit(training, settings, 0, torch.device("cpu"))
    first = glance(fit, 2, 0, 1.0)
    avatar = run_fit(fit, Budget(), SilentReport())
    last = glance(fit, 2, 60, 0.5)
    assert last.psnr > first.psnr + 3.0
    frame = last.frame
    assert frame == training.train[2]
    np.testing.assert_array_equal(last.truth, training.frame(frame))
    drawn = avatar.render(training.hand_poses(frame), training.camera(frame))[..., :3]
    hand = training.mask(frame) > 127
    # The painted poses are true, so the frame's own place and pose change little.
    assert np.abs(last.avatar[hand] / 255.0 - drawn[hand]).mean() < 0.03
    assert last.weights.max() == 255
    assert last.weights[hand].mean() > 2.0 * last.weights[~hand].mean()


def test_the_turned_picture_is_that_of_a_camera_around_the_hand(
    make_training: TrainingMaker,
) -> None:
    """Oracles: the avatar from the frame's own camera, and from a camera turned by hand."""
    training = make_training()
    fit = make_fit(training, read_settings({**QUICK, "schedule.steps": 30}), 0, torch.device("cpu"))
    avatar = run_fit(fit, Budget(), SilentReport())
    frame = int(training.train[2])
    hands, camera = training.hand_poses(frame), training.camera(frame)
    for angle in (0.0, 0.5, np.pi):
        turned = glance(fit, 2, 30, 0.5, angle).turned / 255.0
        positions = fit.clip.poses(torch.tensor([2])).positions[0].double().numpy()
        middle = camera.viewmat[:3, :3] @ positions.mean(axis=0) + camera.viewmat[:3, 3]
        turn = Rotation.from_euler("y", angle).as_matrix()
        viewmat = camera.viewmat.copy()
        viewmat[:3, :3] = turn @ camera.viewmat[:3, :3]
        viewmat[:3, 3] = turn @ (camera.viewmat[:3, 3] - middle) + middle
        drawn = avatar.render(hands, dataclasses.replace(camera, viewmat=viewmat))[..., :3]
        assert np.abs(turned - drawn).max() < 0.01
        assert (turned.max(axis=-1) > 0.1).mean() > 0.02


def test_an_address_without_a_page_is_refused(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["fit", str(tmp_path / "hand.mp4"), "--port", "9000"]) == 2
    told = capsys.readouterr().err
    assert "--port" in told
    assert "Give --live" in told


def test_the_avatar_turns_with_each_look(
    make_training: TrainingMaker, monkeypatch: pytest.MonkeyPatch
) -> None:
    fit = make_fit(make_training(), read_settings(QUICK), 0, torch.device("cpu"))
    angles: list[float] = []

    def look(fit: Fit, row: int, step: int, loss: float, angle: float) -> None:
        angles.append(angle)

    monkeypatch.setattr("wildghand.fitting.glance.glance", look)
    live = Live(lambda look: None, pause=0.0)
    for step in range(25):
        live(fit, step, 0.1)
    assert np.allclose(np.diff(angles), np.deg2rad(15.0))


def test_the_clock_of_a_fit_stands_still_while_it_is_watched(
    make_painted: Callable[..., Capture],
) -> None:
    slept = []

    def watch(fit: Fit, step: int, loss: Any) -> None:
        began = time.perf_counter()
        time.sleep(0.5)
        slept.append(time.perf_counter() - began)

    began = time.perf_counter()
    settings = {**QUICK, "prior": ""}
    avatar = fit_capture(
        make_painted().root, settings=settings, budget=Budget(steps=4), watch=watch
    )
    took = time.perf_counter() - began
    assert len(slept) == 4
    assert 0.0 < avatar.record.seconds <= took - sum(slept)


def test_a_look_waits_for_its_time_and_for_somebody_who_looks(
    make_training: TrainingMaker, monkeypatch: pytest.MonkeyPatch
) -> None:
    fit = make_fit(make_training(), read_settings(QUICK), 0, torch.device("cpu"))
    now, seen, looked = [100.0], [], [False]
    monkeypatch.setattr("wildghand.fitting.glance.time.monotonic", lambda: now[0])

    def show(look: Glance) -> None:
        seen.append(look.step)
        now[0] += 0.5  # seconds that the picture takes

    live = Live(show, wanted=lambda: looked[0], pause=1.0)
    live(fit, 1, 0.1)
    assert seen == []
    looked[0] = True
    live(fit, 2, 0.1)
    assert seen == [2]
    # A tenth of the time: after half a second nothing for the nine times as long.
    now[0] += 4.0
    live(fit, 3, 0.1)
    assert seen == [2]
    now[0] += 1.0
    live(fit, 4, torch.tensor(0.1))
    assert seen == [2, 4]
