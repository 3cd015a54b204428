"""Poses that are fitted too. Oracles: the plain fit's drawing; painted frames with wrong poses."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import torch
from fitted_parts import batch_of, material_of, scores_of
from painted import QUICK, TrainingMaker

from hwp_bench.capture import Capture
from hwp_bench.methods.contract import TrainingCapture
from joint_pose_fit.method import JointPoseMethod, JointPoseRecipe
from plain_fit.method import PlainMethod
from wildghand.plain.recipe import FitInputs, PlainRecipe


def materials(
    make_training: TrainingMaker, hands: str = "both"
) -> tuple[FitInputs, JointPoseMethod]:
    return material_of(make_training(hands)), JointPoseMethod({**QUICK, "hold_weight": 0.5})


def test_without_corrections_a_frame_is_drawn_as_by_the_plain_fit(
    make_training: TrainingMaker,
) -> None:
    material, method = materials(make_training)
    batch = batch_of(material, 0, 1)
    ours = JointPoseRecipe(material, method.settings)
    plain = PlainRecipe(material, PlainMethod(QUICK).settings)
    with torch.no_grad():
        assert torch.equal(ours.draw(batch).image, plain.draw(batch).image)


def test_corrections_get_gradients_of_their_frames_alone(make_training: TrainingMaker) -> None:
    material, method = materials(make_training)
    recipe = JointPoseRecipe(material, method.settings)
    for value in recipe.parameters().values():
        value.requires_grad_()
    batch = batch_of(material, 0, 1)
    drawing = recipe.draw(batch)
    recipe.loss(batch, drawing, recipe.weights(batch, drawing)).backward()
    for value in (*recipe.corrections.poses.values(), *recipe.corrections.places.values()):
        assert value.grad is not None
        assert value.grad[:2].abs().sum() > 0.0
        assert not value.grad[2:].any()


def test_the_corrections_are_held_by_their_mean_square(make_training: TrainingMaker) -> None:
    """0.1 rad at each angle and 0.02 m = 0.2 dm: 0.5 (0.01 + 0.04) / 2 on top."""
    material, method = materials(make_training, "right")
    recipe = JointPoseRecipe(material, method.settings)
    batch = batch_of(material, 0, 1)
    drawing = recipe.draw(batch)
    weights = recipe.weights(batch, drawing)
    before = recipe.loss(batch, drawing, weights)
    recipe.corrections.poses["right"].fill_(0.1)
    recipe.corrections.places["right"].fill_(0.02)
    added = recipe.loss(batch, drawing, weights) - before
    torch.testing.assert_close(added, torch.tensor(0.5 * (0.01 + 0.04) / 2), atol=1e-6, rtol=1e-4)


def with_wrong_poses(training: TrainingCapture, degrees: float) -> TrainingCapture:
    """Turn each joint of each training frame by some degrees; test poses stay."""
    random = np.random.default_rng(3)
    for side, hand in training.hands.items():
        pose = hand.pose.copy()
        frames = training.train
        pose[frames] += random.normal(0.0, np.radians(degrees), pose[frames].shape)
        training.hands = {**training.hands, side: replace(hand, pose=pose)}
    return training


def test_wrong_poses_are_corrected(
    make_training: TrainingMaker, make_painted: Callable[[str], Capture]
) -> None:
    """Joints that are 4 degrees off cost the plain fit some 1.6 dB; 0.6 dB must come back."""
    # Faster than by default, since each frame comes five times only.
    settings = {"pose_rate": 3e-3, "transl_rate": 3e-4}
    training = with_wrong_poses(make_training(), 4.0)
    plain = PlainMethod({**QUICK, "steps": 150}, 0)
    ours = JointPoseMethod({**QUICK, "steps": 150, **settings}, 0)
    scores = scores_of(training, make_painted("right"), plain, ours)
    assert scores[1] > scores[0] + 0.6, scores
