"""A fit with an appearance of each frame. Oracle: painted frames, some under another light."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import torch
from fitted_parts import scores_of
from painted import QUICK, SilentReport, TrainingMaker

from hwp_bench.capture import Capture
from hwp_bench.methods.contract import Budget, TrainingCapture
from plain_fit.method import PlainMethod
from wild_fit.method import WildMethod

SETTINGS = {**QUICK, "steps": 150}


def under_another_light(training: TrainingCapture) -> TrainingCapture:
    """Two of five training frames are darker and bluer."""
    read = training.frame

    def frame(index: int) -> np.ndarray:
        image = read(index)
        return (image * (0.5, 0.6, 0.8)).astype(np.uint8) if index % 5 < 2 else image

    training.frame = frame  # type: ignore[method-assign]
    return training


def test_another_light_is_told_from_the_hand(
    make_training: TrainingMaker, make_painted: Callable[[str], Capture]
) -> None:
    """It costs the plain fit some 10 dB; 2.5 dB must come back."""
    training = under_another_light(make_training())
    methods = PlainMethod(SETTINGS, 0), WildMethod(SETTINGS, 0)
    scores = scores_of(training, make_painted("right"), *methods)
    assert scores[1] > scores[0] + 2.5, scores


def test_the_same_seed_gives_the_same_picture(make_training: TrainingMaker) -> None:
    training = make_training()
    frame = int(training.targets[0])
    images = []
    for seed in (3, 3, 4):
        avatar = WildMethod(QUICK, seed).fit(training, Budget(steps=8), SilentReport())
        images.append(avatar.render(training.hand_poses(frame), training.camera(frame)))
    np.testing.assert_array_equal(images[0], images[1])
    assert not np.array_equal(images[0], images[2])


def test_drawing_a_checkpoint_does_not_disturb_the_fit(make_training: TrainingMaker) -> None:
    class Drawing(SilentReport):
        def __call__(self, step, avatar) -> None:  # type: ignore[no-untyped-def]
            super().__call__(step, avatar)
            frame = int(training.validation[0])
            avatar.render(training.hand_poses(frame), training.camera(frame))

    training = make_training()
    fits = [
        WildMethod(QUICK, 0).fit(training, Budget(steps=8), report())
        for report in (Drawing, SilentReport)
    ]
    ours, theirs = (fit.plain.model.parameters() for fit in fits)
    for name, value in ours.items():
        assert torch.equal(value, theirs[name]), name
