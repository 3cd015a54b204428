"""The method on clips of one colour, of one training frame and of none that shows a hand.

Oracles: every number of the avatar is finite, and so is every score; the message of the error.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from painted import FRAMES, SilentReport, TrainingMaker
from tiny_fits import TINY

from hwp_bench.base.errors import BadInput
from hwp_bench.capture import Capture
from hwp_bench.capture.splits import Split
from hwp_bench.methods.contract import Budget, RunSettings, TrainingCapture
from hwp_bench.methods.request import open_request, write_request
from hwp_bench.metrics.score import score_frame
from wildghand.avatar.avatar import WildGHandAvatar
from wildghand.fitting.method import WildGHandMethod

SHORT: dict[str, Any] = {**TINY, "gaussians": 600, "schedule.steps": 12}


def fitted(training: TrainingCapture, **changes: Any) -> WildGHandAvatar:
    return WildGHandMethod({**SHORT, **changes}, 0).fit(training, Budget(), SilentReport())


def check(avatar: WildGHandAvatar, training: TrainingCapture, truth: np.ndarray) -> None:
    """The avatar, its picture of a test frame and the scores are finite, and a hand is seen."""
    assert avatar.model.finite()
    frame = int(training.targets[0])
    rgba = avatar.render(training.hand_poses(frame), training.camera(frame))
    assert np.isfinite(rgba).all()
    seen = rgba[..., 3] > 0.5
    assert seen.any()
    scores = score_frame(np.clip(rgba[..., :3], 0.0, 1.0), truth, seen)
    assert all(np.isfinite(value) for value in scores.values()), scores


#: Colours of every pixel of every frame, of 255.
COLOURS = [(0, 0, 0), (128, 128, 128), (255, 255, 255), (200, 150, 120)]


def flat(training: TrainingCapture, colour: tuple[int, int, int]) -> TrainingCapture:
    """Every pixel of every frame has one colour."""
    read = training.frame
    training.frame = lambda index: np.full_like(read(index), colour)  # type: ignore[method-assign]
    return training


@pytest.mark.parametrize(
    ("colour", "changes"),
    [
        *[(COLOURS[0], {"mode": mode, "schedule.epochs": 1}) for mode in ("paper", "released")],
        (COLOURS[2], {"mode": "paper", "schedule.epochs": 1}),
        *[(colour, {"prepass.enabled": False}) for colour in COLOURS],
    ],
    ids=str,
)
def test_a_clip_of_one_colour_gives_a_finite_avatar(
    colour: tuple[int, int, int], changes: dict[str, Any], make_training: TrainingMaker
) -> None:
    training = flat(make_training(), colour)
    check(fitted(training, **changes), training, training.frame(0))


@pytest.mark.parametrize("colour", COLOURS, ids=str)
def test_the_judge_says_that_a_clip_has_one_colour(
    colour: tuple[int, int, int], make_training: TrainingMaker
) -> None:
    with pytest.raises(BadInput, match="32 of them are black or of one colour"):
        fitted(flat(make_training(), colour))


def request(capture: Capture, train: tuple[int, int], path: Path) -> TrainingCapture:
    """What a method is given of the capture where `train` are its training frames."""
    split = Split(capture.info.id, FRAMES, train, (FRAMES - 8, FRAMES - 4), (FRAMES - 4, FRAMES))
    return open_request(write_request(path, capture, split, RunSettings({}, 0, Budget())))


def test_one_training_frame_is_enough(make_painted, tmp_path: Path) -> None:  # type: ignore[no-untyped-def]
    capture = make_painted("right")
    training = request(capture, (3, 4), tmp_path / "request")
    assert training.train.tolist() == [3]
    check(fitted(training), training, capture.frame(FRAMES - 1))


def test_no_frame_that_shows_a_hand_is_one_message(make_training: TrainingMaker) -> None:
    training = make_training()
    read = training.mask
    training.mask = lambda index: np.zeros_like(read(index))  # type: ignore[method-assign]
    with pytest.raises(BadInput, match="training frame"):
        fitted(training)
