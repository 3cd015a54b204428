"""The fit as the benchmark runs it. Oracle: frames drawn by an avatar of known parameters."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
import torch
from painted import QUICK, SilentReport, TrainingMaker, masked_psnr, painted_avatar

from hwp_bench.base.errors import DidNotConverge, MissingDependency, UsageError
from hwp_bench.capture import Capture
from hwp_bench.methods.contract import Budget, Camera, HandPose, TrainingCapture
from plain_fit.method import PlainMethod
from wildghand.plain.model import PlainAvatar


def upright(side: str) -> HandPose:
    pose = np.zeros((16, 3))
    pose[0] = [np.pi / 2, 0.0, 0.0]
    towards = 1.0 if side == "right" else -1.0
    return HandPose(side, pose, np.zeros(10), np.array([0.09 * towards, 0.0, 0.45]))


def small_camera() -> Camera:
    return Camera(np.array([[60.0, 0, 20], [0, 60.0, 24], [0, 0, 1]]), np.eye(4), 40, 48)


@pytest.mark.parametrize("hands", ["right", "left", "both"])
def test_a_short_fit_finds_the_texture_and_the_light(
    make_training: TrainingMaker, make_painted: Callable[[str], Capture], hands: str
) -> None:
    """The hand in its mean colour scores about 19 dB; 100 steps must reach 24 dB."""
    training = make_training(hands)
    capture = make_painted(hands)
    report = SilentReport()
    avatar = PlainMethod(QUICK, 0).fit(training, Budget(), report)
    score = masked_psnr(avatar, training, capture)
    assert score > 24.0
    assert report.done[-1] == (100, 100)
    assert [step for step, _ in report.offers] == list(range(101))
    assert avatar.steps == 100
    assert avatar.device == "cpu"


def test_the_same_seed_gives_the_same_bits(make_training: TrainingMaker) -> None:
    training = make_training()
    fits = [
        PlainMethod(QUICK, seed).fit(training, Budget(steps=15), SilentReport())
        for seed in (3, 3, 4)
    ]
    values = [fit.model.parameters() for fit in fits]
    for name, value in values[0].items():
        assert torch.equal(value, values[1][name]), name
    assert not torch.equal(values[0]["logit_colors"], values[2]["logit_colors"])


class RenderingReport(SilentReport):
    """Draws every avatar at once, as the benchmark does when a checkpoint is due."""

    def __init__(self, training: TrainingCapture) -> None:
        super().__init__()
        self.training = training
        self.images: list[np.ndarray] = []

    def __call__(self, step: int, avatar: PlainAvatar) -> None:  # type: ignore[override]
        super().__call__(step, avatar)
        frame = int(self.training.validation[0])
        image = avatar.render(self.training.hand_poses(frame), self.training.camera(frame))
        self.images.append(image)


def test_drawing_checkpoints_does_not_disturb_the_fit(make_training: TrainingMaker) -> None:
    training = make_training()
    report = RenderingReport(training)
    watched = PlainMethod(QUICK, 0).fit(training, Budget(steps=20), report)
    alone = PlainMethod(QUICK, 0).fit(training, Budget(steps=20), SilentReport())
    for name, value in alone.model.parameters().items():
        assert torch.equal(value, watched.model.parameters()[name]), name
    frame = int(training.validation[0])
    last = watched.render(training.hand_poses(frame), training.camera(frame))
    np.testing.assert_array_equal(report.images[-1], last)


def test_the_fit_stops_when_its_seconds_are_over(make_training: TrainingMaker) -> None:
    """The report's clock runs a second every step, and before the first."""
    avatar = PlainMethod(QUICK, 0).fit(make_training(), Budget(seconds=2.5), SilentReport())
    assert avatar.steps == 2


def test_no_steps_give_the_start(make_training: TrainingMaker) -> None:
    avatar = PlainMethod(QUICK, 0).fit(make_training(), Budget(seconds=0.0), SilentReport())
    assert avatar.steps == 0


def test_a_fit_that_explodes_at_once_says_so(make_training: TrainingMaker) -> None:
    settings = {**QUICK, "light_rate": 1e30, "offset_rate": 1e30}
    with pytest.raises(DidNotConverge, match="diverged"):
        PlainMethod(settings, 0).fit(make_training(), Budget(), SilentReport())


def test_images_have_the_contract_s_shape_and_range() -> None:
    avatar = painted_avatar(("right",))
    image = avatar.render({"right": upright("right")}, small_camera())
    assert image.shape == (48, 40, 4)
    assert image.dtype == np.float32
    assert 0.0 <= image.min() < image.max() <= 1.0
    background = image[..., 3] == 0.0
    assert background.any()
    assert not image[background].any()


def test_one_hand_of_two_is_drawn_as_if_alone() -> None:
    avatar = painted_avatar(("right", "left"))
    both = {side: upright(side) for side in ("right", "left")}
    for side, other in (("right", "left"), ("left", "right")):
        away = replace(both[other], transl=np.array([0.0, 9.0, 0.4]))
        np.testing.assert_allclose(
            avatar.render({side: both[side]}, small_camera()),
            avatar.render({**both, other: away}, small_camera()),
            atol=1e-6,
        )


def test_a_hand_that_was_not_fitted_is_refused() -> None:
    avatar = painted_avatar(("right",))
    with pytest.raises(UsageError, match="left"):
        avatar.render({"left": upright("left")}, small_camera())
    with pytest.raises(UsageError, match="hands"):
        avatar.render({}, small_camera())


def test_a_pose_that_is_no_number_gives_a_finite_image() -> None:
    avatar = painted_avatar(("right",))
    hand = replace(upright("right"), transl=np.array([np.nan, 0.0, 0.4]))
    assert np.isfinite(avatar.render({"right": hand}, small_camera())).all()


def test_cuda_without_a_gpu_is_an_error(
    make_training: TrainingMaker, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    with pytest.raises(MissingDependency, match="device"):
        PlainMethod({**QUICK, "device": "cuda"}, 0).fit(make_training(), Budget(), SilentReport())
