"""Frames that are means over a motion. Oracles: paths in closed form; frames blurred by drawing."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from fitted_parts import batch_of, material_of, scores_of
from formed import drawn, formed_capture, over, train_frames, training_of
from painted import (
    FRAMES,
    QUICK,
    SilentReport,
    TrainingMaker,
    hand_parameters,
    painted_avatar,
)
from scipy.spatial.transform import Rotation

from exposure_fit.method import ExposureMethod, ExposureRecipe, motion_px, nearest_turn, velocities
from hwp_bench.capture import Capture
from hwp_bench.hands.skeleton import HandParameters
from hwp_bench.methods.contract import Budget, TrainingCapture
from plain_fit.method import PlainMethod
from wildghand.plain.model import PlainAvatar


def test_the_nearest_vector_is_the_same_rotation() -> None:
    """Oracle: SciPy's rotations; and nothing nearer among the turns by whole numbers."""
    random = np.random.default_rng(0)
    pose = random.normal(size=(200, 3))
    pose *= random.uniform(0.0, 2.0 * math.pi, (200, 1)) / np.linalg.norm(pose, axis=1)[:, None]
    to = random.normal(size=(200, 3)) * 2.0
    near = nearest_turn(pose, to)
    same = Rotation.from_rotvec(pose).inv() * Rotation.from_rotvec(near)
    assert same.magnitude().max() < 1e-9
    assert (np.linalg.norm(near - to, axis=1) <= np.linalg.norm(pose - to, axis=1) + 1e-12).all()
    np.testing.assert_array_equal(nearest_turn(np.zeros((1, 3)), to[:1]), np.zeros((1, 3)))


def test_a_steady_path_has_one_speed_whatever_is_missing() -> None:
    speed = np.array([0.02, -0.01, 0.005])
    values = np.arange(8.0)[:, None] * speed + 1.0
    valid = np.array([True, True, False, True, False, True, True, True])
    indices = np.array([0, 1, 5, 7])
    np.testing.assert_allclose(velocities(values, valid, indices), np.tile(speed, (4, 1)))
    np.testing.assert_array_equal(velocities(values, valid, np.array([3])), np.zeros((1, 3)))


def test_a_jump_by_a_whole_turn_is_no_motion() -> None:
    """A wrist that turns steadily through half a turn; a tracker wraps its vector there."""
    angles = math.pi + 0.1 * (np.arange(6) - 2.5)
    axis = np.array([0.6, 0.0, 0.8])
    wrapped = np.where(angles > math.pi, angles - 2.0 * math.pi, angles)
    pose = wrapped[:, None, None] * axis
    speeds = velocities(pose, np.ones(6, dtype=bool), np.arange(6), turns=True)
    np.testing.assert_allclose(speeds, np.broadcast_to(0.1 * axis, (6, 1, 3)), atol=1e-12)


def test_motion_is_that_of_the_projection() -> None:
    """Points at depth z that move by d across move by f d / z px."""
    start = torch.tensor([[[0.0, 0.0, 0.5]] * 40, [[0.1, 0.0, -0.5]] * 40], dtype=torch.float64)
    end = start + torch.tensor([0.01, 0.0, 0.0])
    K = torch.tensor([[90.0, 0.0, 32.0], [0.0, 90.0, 32.0], [0.0, 0.0, 1.0]], dtype=torch.float64)
    got = motion_px(start, end, torch.eye(4).double().expand(2, 4, 4), K.expand(2, 3, 3))
    torch.testing.assert_close(got, torch.tensor([90.0 * 0.01 / 0.5, 0.0], dtype=torch.float64))


def waving_hand() -> HandParameters:
    """A hand that goes up to 6 px from frame to frame, to and fro."""
    phase = 2.0 * math.pi * np.arange(FRAMES) / 12.0
    hand = hand_parameters("right", 0)
    transl = hand.transl.copy()
    transl[:, 0] += 0.05 * np.sin(phase)
    return replace(hand, transl=transl)


def fine_avatar() -> PlainAvatar:
    """The painted avatar with finer and stronger stripes."""
    avatar = painted_avatar(("right",))
    model = avatar.model
    rig = model.rigs["right"]
    corners = rig.template.vertices[rig.template.faces[rig.anchors.face_index]]
    place = (corners * rig.anchors.barycentric[..., None]).sum(dim=1)
    with torch.no_grad():
        model.gaussians.logit_colors.add_(1.2 * torch.sin(250.0 * place))
    return avatar


def exposed_training(path: Path) -> tuple[TrainingCapture, Capture]:
    """Training frames whose shutter is open for the whole time between two frames."""
    hand, avatar, blurred = waving_hand(), fine_avatar(), train_frames()
    steps = np.arange(FRAMES)

    def at(values: np.ndarray, time: float) -> np.ndarray:
        flat = values.reshape(FRAMES, -1)
        made = [np.interp(time, steps, column) for column in flat.T]
        return np.array(made).reshape(values.shape[1:])

    def picture(frame: int) -> tuple[np.ndarray, np.ndarray]:
        sharp = drawn(avatar, hand.pose[frame], hand, hand.transl[frame])
        times = frame + np.linspace(-0.5, 0.5, 15) if frame in blurred else [float(frame)]
        mean = np.mean(
            [drawn(avatar, at(hand.pose, t), hand, at(hand.transl, t)) for t in times], axis=0
        )
        return over(mean), sharp[..., 3] > 0.5

    capture = formed_capture(path / "exposed", hand, picture)
    return training_of(capture, path / "request"), capture


def test_frames_at_rest_are_drawn_as_in_the_plain_fit(make_training: TrainingMaker) -> None:
    """With a threshold that nothing exceeds the fit is the plain one, bit for bit."""
    training = make_training()
    settings = {**QUICK, "least_motion": 1e6}
    slow = ExposureMethod(settings, 0).fit(training, Budget(steps=8), SilentReport())
    plain = PlainMethod(QUICK, 0).fit(training, Budget(steps=8), SilentReport())
    for name, value in plain.model.parameters().items():
        assert torch.equal(value, slow.model.parameters()[name]), name


def test_an_exposure_is_the_mean_of_its_moments(make_training: TrainingMaker) -> None:
    """Oracle: each moment drawn alone, from ends that are given."""
    training = make_training()
    method = ExposureMethod({**QUICK, "least_motion": 0.0, "moments": 3})
    recipe = ExposureRecipe(material_of(training), method.settings)
    assert recipe.moving.all()
    batch = batch_of(recipe.material, 4)
    row = batch.rows
    recipe.ends["transl.right"][4] = torch.tensor([[-0.02, 0.0, 0.0], [0.04, 0.01, 0.0]])
    recipe.ends["pose.right"][4] = 0.0
    pose, betas, transl = recipe.clip.parameters["right"]
    rig, images = recipe.model.rigs["right"], []
    for moved in ([-0.02, 0.0, 0.0], [0.01, 0.005, 0.0], [0.04, 0.01, 0.0]):
        poses = rig.pose(pose[row], betas, transl[row] + torch.tensor(moved))
        views = recipe.clip.viewmats[row], recipe.clip.Ks[row]
        images.append(recipe.model.render(poses, *views, training.width, training.height)[0])
    torch.testing.assert_close(
        recipe.draw(batch).image, torch.stack(images).mean(dim=0), atol=1e-5, rtol=1e-5
    )


@pytest.mark.slow
def test_a_sharp_hand_comes_out_of_blurred_frames(tmp_path: Path) -> None:
    """Training frames are means over up to 6 px; the plain fit must miss by 1 dB at least."""
    training, capture = exposed_training(tmp_path)
    settings = {**QUICK, "gaussians": 1500, "steps": 150}
    sharp = ExposureMethod({**settings, "shutter": 1.0}, 0)
    scores = scores_of(training, capture, PlainMethod(settings, 0), sharp)
    assert scores[1] > scores[0] + 1.0, scores
