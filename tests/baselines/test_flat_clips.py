"""Fits to clips in which nothing varies: black, white or one gray in every pixel of every frame.

Such clips have variances, gradients and histograms of 0, which methods divide by. Oracles: every
number of the avatar is finite; where skin is seen, the picture has the one colour of the clip.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from painted import QUICK, SilentReport, TrainingMaker

from complementary_masks_fit.method import ComplementaryMasksMethod
from delayed_mask_fit.method import DelayedMaskMethod
from exposure_fit.method import ExposureMethod
from hwp_bench.methods.contract import Budget, TrainingCapture
from hwp_bench.metrics.score import score_frame
from plain_fit.method import PlainMethod
from trimmed_fit.method import TrimmedMethod
from wild_fit.method import WildMethod
from zero_mean_exposure_fit.method import ZeroMeanExposureMethod

METHODS: dict[str, tuple[Callable[..., Any], dict[str, Any]]] = {
    "plain": (PlainMethod, {}),
    "trimmed": (TrimmedMethod, {}),
    "trimmed-vote": (TrimmedMethod, {"inliers": "vote"}),
    "wild": (WildMethod, {}),
    "exposure": (ExposureMethod, {}),
    "complementary-masks": (ComplementaryMasksMethod, {}),
    "delayed-mask": (DelayedMaskMethod, {}),
    "zero-mean-exposure": (ZeroMeanExposureMethod, {}),
}
#: Levels of all pixels, of 255.
LEVELS = (0, 128, 255)


def flat(training: TrainingCapture, level: int) -> TrainingCapture:
    """Every pixel of every frame has one level."""
    read = training.frame
    training.frame = lambda index: np.full_like(read(index), level)  # type: ignore[method-assign]
    return training


@pytest.mark.parametrize("level", LEVELS)
@pytest.mark.parametrize("name", METHODS)
def test_a_clip_of_one_colour_gives_an_avatar_of_that_colour(
    name: str, level: int, make_training: TrainingMaker
) -> None:
    method, settings = METHODS[name]
    training = flat(make_training(), level)
    avatar = method({**QUICK, **settings, "steps": 30}, 0).fit(training, Budget(), SilentReport())
    # The avatar of `wild` makes its plain one when it is first drawn.
    model = getattr(avatar, "plain", avatar).model
    for key, value in model.parameters().items():
        assert value.isfinite().all(), key
    frame = int(training.targets[0])
    rgba = avatar.render(training.hand_poses(frame), training.camera(frame))
    assert np.isfinite(rgba).all()
    seen = rgba[..., 3] > 0.9
    assert seen.any()
    truth = np.full((*seen.shape, 3), level, np.uint8)
    scores = score_frame(np.clip(rgba[..., :3], 0.0, 1.0), truth, seen)
    assert all(np.isfinite(value) for value in scores.values()), scores
    # A fifth of the range: 30 steps from the mean colour, which is the clip's.
    colour = rgba[seen][:, :3] / rgba[seen][:, 3:]
    assert np.abs(colour - level / 255.0).mean() < 0.2
