"""A request holds no test pixel, no truth and no word about perturbations.

What an oracle gives in place of estimates. Oracle: the capture's own files.
"""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from small_captures import CaptureMaker

from hwp_bench.base.errors import BadImage, BadInput, UsageError
from hwp_bench.capture import Capture
from hwp_bench.capture.schema import TRUE_TEMPLATE, write_subject_mesh
from hwp_bench.capture.splits import contiguous_split
from hwp_bench.hands import load_template
from hwp_bench.hands.skinning import pose_parameters
from hwp_bench.methods.contract import Budget, RunSettings
from hwp_bench.methods.request import (
    ORACLE_INPUTS,
    choose_training_inputs,
    frame_choice,
    frames_of_true_poses,
    known_oracle_inputs,
    open_request,
    write_request,
)

RUN = RunSettings({"steps": 3}, seed=7, budget=Budget(seconds=5.0))


def test_a_request_holds_what_a_method_may_see(make_capture: CaptureMaker, tmp_path: Path) -> None:
    capture = make_capture(frames=20, truth=True, hands="both")
    split = contiguous_split("tiny", 20)
    root = write_request(tmp_path / "request", capture, split, RUN)
    training = open_request(root)
    for frame in [*split.train, *split.validation]:
        np.testing.assert_array_equal(training.frame(frame), capture.frame(frame))
        np.testing.assert_array_equal(training.mask(frame), capture.mask(frame))
    assert set(training.hand_poses(19)) == {"right", "left"}
    np.testing.assert_array_equal(
        training.hand_poses(19)["left"].transl, capture.hands["left"].transl[19]
    )
    np.testing.assert_array_equal(training.camera(19).K, capture.cameras.Ks[19])
    assert training.run == RUN
    assert list(training.targets) == [18, 19]


def test_no_test_pixel_no_truth_no_link_and_no_word_about_perturbations(
    make_capture: CaptureMaker, tmp_path: Path
) -> None:
    capture = make_capture(frames=20, truth=True)
    root = write_request(tmp_path / "request", capture, contiguous_split("tiny", 20), RUN)
    files = sorted(path.relative_to(root).as_posix() for path in root.rglob("*") if path.is_file())
    pixels = [f"{kind}/{frame:06d}.png" for kind in ("frames", "masks") for frame in range(18)]
    assert files == sorted([*pixels, "cameras.npz", "hands.npz", "request.json"])
    assert not any(path.is_symlink() for path in root.rglob("*"))
    assert all(path.stat().st_nlink == 1 for path in root.rglob("*") if path.is_file())
    text = (root / "request.json").read_text()
    for word in ("motion_blur", "perturbations", str(capture.root), str(tmp_path)):
        assert word not in text
    for frame in (18, 19):
        with pytest.raises(BadImage, match="does not exist"):
            open_request(root).frame(frame)


def test_a_damaged_training_image_is_named_before_the_method_runs(
    make_capture: CaptureMaker, tmp_path: Path
) -> None:
    capture = make_capture(frames=20)
    (capture.root / "frames" / "000003.png").write_bytes(b"")
    with pytest.raises(BadImage, match=r"000003\.png: is empty"):
        write_request(tmp_path / "request", capture, contiguous_split("tiny", 20), RUN)
    assert not (tmp_path / "request").exists()


def test_a_request_that_is_none_is_refused(make_capture: CaptureMaker, tmp_path: Path) -> None:
    with pytest.raises(BadInput, match="does not exist"):
        open_request(tmp_path)
    (tmp_path / "request.json").write_text('{"schema": "hwp-request/1"}')
    with pytest.raises(BadInput, match=r"request\.json: \w+: is missing"):
        open_request(tmp_path)
    (tmp_path / "request.json").write_text('{"schema": "hwp-request/2"}')
    with pytest.raises(BadInput, match="schema: is 'hwp-request/2' where 'hwp-request/1' is read"):
        open_request(tmp_path)


@pytest.mark.parametrize(
    ("change", "problem"),
    [
        ({"width": "wide"}, "width: is 'wide', expected an integer"),
        ({"width": 0}, "width: is 0"),
        ({"hands": "three"}, "hands: is 'three'"),
        ({"budget": {"seconds": "long"}}, "budget.seconds: is 'long'"),
        ({"hand_model": {"name": "anny-1"}}, "hand_model.digest: is missing"),
        ({"settings": []}, "settings: "),
        ({"train": [0, 19]}, "train: has a frame that the split does not train on"),
        ({"train": [-1]}, r"train\[0\]: is -1"),
        ({"extra": 1}, "extra: is not known"),
    ],
)
def test_a_wrong_field_is_named(
    change: dict[str, Any], problem: str, make_capture: CaptureMaker, tmp_path: Path
) -> None:
    split = contiguous_split("tiny", 20)
    root = write_request(tmp_path / "request", make_capture(frames=20), split, RUN)
    value = json.loads((root / "request.json").read_text())
    (root / "request.json").write_text(json.dumps({**value, **change}))
    with pytest.raises(BadInput, match=problem):
        open_request(root)


def test_the_oracles_choose_what_they_say(make_capture: CaptureMaker, tmp_path: Path) -> None:
    capture = make_capture(frames=20, truth=True)
    severities = capture.info.perturbations["motion_blur"]
    perturbed = [frame for frame in range(16) if severities[frame]]
    split = contiguous_split("tiny", 20)
    assert perturbed
    only = replace(RUN, frames="unperturbed-only")
    training = open_request(write_request(tmp_path / "only", capture, split, only))
    assert sorted([*training.train, *perturbed]) == list(range(16))
    for frame in perturbed:
        assert not (training.root / "frames" / f"{frame:06d}.png").exists()
    from hwp_bench.base.images import write_image

    marked = np.full((32, 32, 3), 7, np.uint8)
    write_image(capture.root / "truth" / "clean" / f"{perturbed[0]:06d}.png", marked)
    capture.true_hands["right"].transl[perturbed[0]] += 0.5
    clean = replace(RUN, frames="clean")
    training = open_request(write_request(tmp_path / "clean", capture, split, clean))
    np.testing.assert_array_equal(training.frame(perturbed[0]), marked)
    np.testing.assert_array_equal(training.train, split.train)
    # The estimate was misled in the perturbed frame only; the oracle is given the truth there.
    moved = training.hands["right"].transl - capture.hands["right"].transl
    assert (moved[perturbed[0]] == 0.5).all()
    assert (np.delete(moved, perturbed[0], axis=0) == 0).all()


def test_oracles_need_to_know_the_truth(make_capture: CaptureMaker, tmp_path: Path) -> None:
    split = contiguous_split("tiny", 20)
    plain = make_capture(frames=20)
    with pytest.raises(UsageError, match="does not know its clean frames"):
        write_request(tmp_path / "r", plain, split, replace(RUN, frames="clean"))
    unknown = make_capture("unknown", frames=20, perturbations={"illumination": None})
    with pytest.raises(UsageError, match="in which frames illumination acts"):
        write_request(tmp_path / "r", unknown, split, replace(RUN, frames="unperturbed-only"))
    assert not (tmp_path / "r").exists()


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
        told = frames_of_true_poses(SPLIT, frame_choice([name]))
        np.testing.assert_array_equal(np.flatnonzero(told), rows)
        for field in ("pose", "transl"):
            found = getattr(hand, field)
            np.testing.assert_array_equal(found[rows], getattr(truth, field)[rows])
            np.testing.assert_array_equal(found[others], getattr(estimate, field)[others])
        np.testing.assert_array_equal(hand.betas, estimate.betas)
    for choice in ("perturbed", "clean", frame_choice(["betas", "masks"])):
        assert not frames_of_true_poses(SPLIT, choice).any()


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


def test_vertices_and_joints_are_those_of_the_posed_model(
    make_capture: CaptureMaker, tmp_path: Path
) -> None:
    # Oracle: the model's own forward pass over the whole clip, in float64 as well.
    capture = make_capture(frames=20, hands="both")
    root = write_request(tmp_path / "request", capture, contiguous_split("tiny", 20), RUN)
    training = open_request(root)
    posed = {s: pose_parameters(capture.template(s), capture.hands[s]) for s in capture.info.sides}
    for frame in (3, 19):
        vertices, joints = training.vertices(frame), training.joints(frame)
        given = training.vertices(training.hand_poses(frame))
        assert set(vertices) == set(joints) == set(given) == {"right", "left"}
        for side in capture.info.sides:
            assert vertices[side].shape == capture.template(side).vertices.shape
            np.testing.assert_allclose(vertices[side], posed[side].vertices[frame], atol=1e-12)
            np.testing.assert_allclose(joints[side], posed[side].joints[frame], atol=1e-12)
            np.testing.assert_array_equal(given[side], vertices[side])
    left = replace(training.hands["left"], valid=np.arange(20) != 5)
    other = training.with_hands({**training.hands, "left": left})
    assert set(other.vertices(5)) == {"right"}
    assert set(other.vertices(6)) == {"right", "left"}
