"""MANO as a subject, for those who have it: here a made-up file in its format.

Oracle: the hand model itself, posed with the true parameters, projected and filled by OpenCV.
"""

from __future__ import annotations

import hashlib
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch
from synthetic_mano import write_mirrored_mano

from hwp_bench.base.errors import BadHandModel
from hwp_bench.capture import Capture
from hwp_bench.hands import load_template, pose_hand, project
from hwp_bench.sim.produce.capture import render_capture, render_key
from hwp_bench.sim.scene.scene import Scene
from hwp_bench.sim.subject.hand import skin_atlas, subject_hand

FRAMES, SIZE = 10, 64


@pytest.fixture
def model(tmp_path: Path, small_paintings: None) -> str:
    return f"mano:{write_mirrored_mano(tmp_path / 'mano')}"


def _silhouette(capture: Capture, frame: int, side: str) -> np.ndarray:
    """(S, S) bool: the model in the true pose, every face filled."""
    truth = capture.true_hands
    assert truth is not None
    hand = truth[side]
    template = load_template(capture.info.hand_model.source, side)
    posed = pose_hand(
        template.to_torch(dtype=torch.float64),
        *(torch.as_tensor(array) for array in (hand.pose, hand.betas, hand.transl)),
    )
    pixels, _ = project(
        posed.vertices,
        torch.as_tensor(capture.cameras.viewmats),
        torch.as_tensor(capture.cameras.Ks),
    )
    corners = pixels[frame].numpy()[template.faces]
    filled = np.zeros((SIZE, SIZE), dtype=np.uint8)
    # OpenCV counts from the middle of the first pixel, in sixteenths here.
    for corner in np.round((corners - 0.5) * 16).astype(np.int32):
        cv2.fillConvexPoly(filled, corner, 1, shift=4)
    return filled > 0


def test_the_subject_is_the_model_in_the_true_pose(
    model: str, make_scene: Callable[..., Scene], tmp_path: Path
) -> None:
    scene = make_scene()
    scene = replace(scene, subject=replace(scene.subject, model=model))
    capture = render_capture(
        scene, tmp_path / "capture", frame_count=FRAMES, size=SIZE, workers=1, free_view=False
    )
    template = load_template(model, "right")
    assert capture.info.hand_model.digest == template.digest
    assert capture.info.hand_model.source == model
    files = [Path(model.removeprefix("mano:")) / f"MANO_{side}.pkl" for side in ("RIGHT", "LEFT")]
    digests = [hashlib.sha256(file.read_bytes()).hexdigest() for file in files]
    assert capture.info.source["model_files"] == digests
    last = FRAMES - 1
    shown = capture.true_mask(last) > 127
    expected = _silhouette(capture, last, "right")
    # The sleeve hides the wrist; smoothing and relief move the rim by less than a pixel.
    rim = cv2.dilate(expected.astype(np.uint8), np.ones((3, 3), np.uint8)) > 0
    assert (shown & ~rim).sum() <= 0.01 * shown.sum()
    assert (shown & expected).sum() / expected.sum() > 0.75
    assert capture.frame(last)[shown].std() > 3.0  # painted and lit, not flat


def test_both_hands_are_the_model(
    model: str, make_scene: Callable[..., Scene], tmp_path: Path
) -> None:
    scene = make_scene(
        ('hands = "right"', 'hands = "both"'),
        (
            '{ gesture = "open" }',
            '{ gesture = "open", place = [0.07, 0.0, 0.0] }',
        ),
        ("right = [", 'left = [{ gesture = "open", place = [-0.07, 0.0, 0.0] }]\nright = ['),
    )
    scene = replace(scene, subject=replace(scene.subject, model=model), effects=())
    capture = render_capture(
        scene, tmp_path / "capture", frame_count=FRAMES, size=SIZE, workers=1, free_view=False
    )
    shown = capture.true_mask(0) > 127
    for side in ("right", "left"):
        expected = _silhouette(capture, 0, side)
        assert (shown & expected).sum() / expected.sum() > 0.7


def test_another_file_in_the_same_place_is_another_render(
    tmp_path: Path, make_scene: Callable[..., Scene]
) -> None:
    scene = make_scene()
    folder = write_mirrored_mano(tmp_path / "mano")
    for model in (f"mano:{folder}", f"mano-hd:{folder}"):
        scene = replace(scene, subject=replace(scene.subject, model=model))
        before = render_key(scene, FRAMES, SIZE)
        assert render_key(scene, FRAMES, SIZE) == before
        (folder / "MANO_RIGHT.pkl").write_bytes(model.encode())
        assert render_key(scene, FRAMES, SIZE) != before


def test_a_missing_model_is_one_clear_error(
    make_scene: Callable[..., Scene], tmp_path: Path
) -> None:
    scene = make_scene()
    scene = replace(scene, subject=replace(scene.subject, model=f"mano:{tmp_path / 'nowhere'}"))
    with pytest.raises(BadHandModel, match="nowhere"):
        render_capture(
            scene, tmp_path / "capture", frame_count=FRAMES, size=SIZE, workers=1, free_view=False
        )
    assert not (tmp_path / "capture").exists()


def test_a_left_hand_wears_the_skin_of_its_own_fingers(
    model: str, make_scene: Callable[..., Scene]
) -> None:
    # Oracle: the made-up left hand is the right one mirrored, face by face, and so is its skin;
    # two charts sample it at other places, which moves the mean of a face by 0.006 on average. The
    # right hand's skin on the left hand's chart is off by 0.03.
    subject = replace(make_scene().subject, model=model)
    means = []
    for side in ("right", "left"):
        hand, skin = subject_hand(subject, side), skin_atlas(subject, side).albedo
        column, row = (hand.corner_uv.mean(axis=1) * [1.0, -1.0] % 1.0 * len(skin)).astype(int).T
        means.append(skin[row, column].reshape(4, 4, -1, 3).mean(axis=(0, 1)))
    assert np.abs(means[0] - means[1]).mean() < 0.01


def test_hands_of_one_chart_share_their_skin(
    make_scene: Callable[..., Scene], small_paintings: None
) -> None:
    subject = make_scene().subject
    assert skin_atlas(subject, "left") is skin_atlas(subject, "right")
