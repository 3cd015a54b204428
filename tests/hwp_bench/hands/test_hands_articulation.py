"""Rotations against scipy's Rotation (float64: 1e-14, float32: 1e-6) and finite differences."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from scipy.spatial.transform import Rotation

from hwp_bench.base.errors import BadHandModel
from hwp_bench.hands import (
    HandTemplate,
    anatomical_limits,
    joint_angles,
    joint_axes,
    joint_limit_penalty,
    load_template,
    pose_from_joint_angles,
    pose_hand,
)
from hwp_bench.hands.articulation import (
    axis_angle_to_matrix,
    matrix_to_axis_angle,
    rest_flexion,
    right_jacobian,
)
from hwp_bench.hands.skeleton import FINGERS, finger_joints, palm_directions
from hwp_bench.hands.template import rebuilt

LENGTHS = (0.0, 1e-300, 1e-20, 1e-8, 1e-4, 0.0999, 0.1, 0.1001, 1.0, 3.0, np.pi, 6.0, 50.0)


def vectors_of(lengths: tuple[float, ...], seed: int = 1) -> np.ndarray:
    directions = np.random.default_rng(seed).normal(size=(len(lengths), 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    return directions * np.array(lengths)[:, None]


def test_matrices_agree_with_scipy_at_every_length() -> None:
    vectors = vectors_of(LENGTHS)
    ours = axis_angle_to_matrix(torch.from_numpy(vectors)).numpy()
    np.testing.assert_allclose(ours, Rotation.from_rotvec(vectors).as_matrix(), atol=2e-14)


@given(st.lists(st.floats(-7.0, 7.0, width=32), min_size=3, max_size=3))
def test_float32_matrices_agree_with_scipy(vector: list[float]) -> None:
    ours = axis_angle_to_matrix(torch.tensor(vector, dtype=torch.float32)).numpy()
    np.testing.assert_allclose(ours, Rotation.from_rotvec(vector).as_matrix(), atol=2e-6)


@pytest.mark.parametrize("length", [0.0, 1e-5, 0.0999, 0.1001, 1.0, 3.1, 7.0])
def test_gradients_agree_with_finite_differences(length: float) -> None:
    vector = torch.from_numpy(vectors_of((length,))).requires_grad_()
    assert torch.autograd.gradcheck(axis_angle_to_matrix, (vector,))
    assert torch.autograd.gradgradcheck(axis_angle_to_matrix, (vector,))


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_gradient_is_finite_at_every_length(dtype: torch.dtype) -> None:
    vectors = torch.from_numpy(vectors_of(LENGTHS)).to(dtype).requires_grad_()
    axis_angle_to_matrix(vectors).sum().backward()
    assert vectors.grad is not None
    assert torch.isfinite(vectors.grad).all()


@pytest.mark.parametrize("dtype", [torch.float16, torch.bfloat16])
def test_half_precision_is_computed_in_float32(dtype: torch.dtype) -> None:
    vectors = torch.from_numpy(vectors_of((0.0, 0.05, 1.0, 40.0, 300.0))).to(dtype)
    ours = axis_angle_to_matrix(vectors)
    assert ours.dtype == dtype
    expected = Rotation.from_rotvec(vectors.double().numpy()).as_matrix()
    # Rounding to the type; the angle itself is off by 300 ulp of float32.
    np.testing.assert_allclose(
        ours.double(), expected, atol=0.5 * torch.finfo(dtype).eps + 300 * 2.0**-23
    )


@pytest.mark.parametrize(("dtype", "limit"), [(torch.float32, 4.2e9), (torch.float64, 1.1e77)])
def test_only_the_axis_of_a_huge_vector_matters(dtype: torch.dtype, limit: float) -> None:
    axes = torch.from_numpy(vectors_of((1.0,) * 4, 6)).to(dtype)
    axes = axes / axes.abs().amax(dim=-1, keepdim=True)
    first, second = (axis_angle_to_matrix(axes * limit * share) for share in (1e3, 1e9))
    turned = torch.einsum("nij,nj->ni", first, axes)
    tolerance = 32 * torch.finfo(dtype).eps
    np.testing.assert_allclose(turned, axes, atol=tolerance)
    np.testing.assert_allclose(torch.linalg.det(second), 1.0, atol=tolerance)


@pytest.mark.parametrize("length", [0.0, 1e-9, 1e-3, 0.19, 0.21, 1.0, 2.5, 3.1415])
def test_vectors_come_back_from_matrices(length: float) -> None:
    vectors = torch.from_numpy(np.concatenate([vectors_of((length,), seed) for seed in range(20)]))
    back = matrix_to_axis_angle(axis_angle_to_matrix(vectors))
    np.testing.assert_allclose(back, vectors, atol=1e-12)


def test_half_turns_give_an_axis_of_length_pi() -> None:
    matrices = torch.from_numpy(Rotation.from_rotvec(vectors_of((np.pi,) * 30, 3)).as_matrix())
    vectors = matrix_to_axis_angle(matrices)
    np.testing.assert_allclose(vectors.norm(dim=1), np.pi, atol=1e-9)
    np.testing.assert_allclose(axis_angle_to_matrix(vectors), matrices, atol=1e-9)


@pytest.mark.parametrize("length", [0.0, 0.05, 1.0, 2.9])
def test_inverse_gradients_agree_with_finite_differences(length: float) -> None:
    vector = torch.from_numpy(vectors_of((length,), 4)).requires_grad_()
    # Through both maps, so that the differences stay on the rotation group.
    assert torch.autograd.gradcheck(
        lambda v: matrix_to_axis_angle(axis_angle_to_matrix(v)), (vector,)
    )


@settings(max_examples=30, deadline=None)
@given(arrays(float, 3, elements=st.floats(-2.5, 2.5)), arrays(float, 3, elements=st.floats(-1, 1)))
def test_rates_of_rotations_are_those_of_scipy(vector: np.ndarray, direction: np.ndarray) -> None:
    # Central differences of 1e-5: 1e-8.
    step = 1e-5 * direction
    turn = Rotation.from_rotvec(vector - step).inv() * Rotation.from_rotvec(vector + step)
    np.testing.assert_allclose(
        right_jacobian(vector) @ direction, turn.as_rotvec() / 2e-5, atol=1e-7
    )


SIDES = ("right", "left")


@pytest.fixture(params=SIDES)
def hand(request: pytest.FixtureRequest) -> HandTemplate:
    return load_template(side=request.param)


def tip_motion(hand: HandTemplate, joint: int, axis: int, finger: str) -> np.ndarray:
    """How a finger's tip moves when one joint turns by +20 degrees about one of its axes."""
    angles = torch.zeros(1, 15, 3, dtype=torch.float64)
    angles[0, joint - 1, axis] = np.deg2rad(20.0)
    pose = torch.zeros(1, 16, 3, dtype=torch.float64)
    pose[:, 1:] = pose_from_joint_angles(angles, torch.from_numpy(joint_axes(hand)))
    betas, transl = torch.zeros(10, dtype=torch.float64), torch.zeros(1, 3, dtype=torch.float64)
    posed = pose_hand(hand.to_torch(torch.float64), pose, betas, transl)
    tip = hand.fingertips[FINGERS.index(finger)]
    return posed.vertices[0, tip].numpy() - hand.vertices[tip]


@pytest.mark.parametrize("finger", FINGERS[1:])
def test_flexion_brings_the_tip_towards_the_palm(hand: HandTemplate, finger: str) -> None:
    palm = palm_directions(hand.joints, hand.side)
    for joint in finger_joints(finger):
        motion = tip_motion(hand, joint, 0, finger)
        assert motion @ palm.palmar > 0.6 * np.linalg.norm(motion)


@pytest.mark.parametrize("finger", FINGERS[1:])
def test_abduction_moves_fingers_towards_the_thumb(hand: HandTemplate, finger: str) -> None:
    palm = palm_directions(hand.joints, hand.side)
    motion = tip_motion(hand, finger_joints(finger)[0], 1, finger)
    assert motion @ palm.thumbward > 0.8 * np.linalg.norm(motion)


def test_thumb_flexes_across_the_palm_and_abducts_out_of_it(hand: HandTemplate) -> None:
    palm = palm_directions(hand.joints, hand.side)
    for joint in finger_joints("thumb"):
        assert tip_motion(hand, joint, 0, "thumb") @ palm.thumbward < -0.002
    assert tip_motion(hand, 13, 1, "thumb") @ palm.palmar > 0.002


def test_left_axes_are_the_mirrored_right_axes(
    free_right: HandTemplate, free_left: HandTemplate
) -> None:
    axial = np.array([1.0, -1.0, -1.0])[:, None]
    np.testing.assert_allclose(joint_axes(free_left), joint_axes(free_right) * axial, atol=1e-12)
    right, left = anatomical_limits(free_right), anatomical_limits(free_left)
    np.testing.assert_allclose(right.lower, left.lower, atol=1e-12)
    np.testing.assert_allclose(right.upper, left.upper, atol=1e-12)


def test_axes_are_rotations(hand: HandTemplate) -> None:
    axes = joint_axes(hand)
    np.testing.assert_allclose(
        axes.swapaxes(1, 2) @ axes, np.broadcast_to(np.eye(3), axes.shape), atol=1e-12
    )
    np.testing.assert_allclose(np.linalg.det(axes), 1.0)


def test_the_open_rest_hand_is_slightly_bent(hand: HandTemplate) -> None:
    degrees = np.rad2deg(rest_flexion(hand))
    assert (degrees > -5.0).all()
    assert (degrees < 25.0).all()


def test_angles_agree_with_scipys_intrinsic_euler_angles(free_right: HandTemplate) -> None:
    axes = joint_axes(free_right)
    pose = np.random.default_rng(0).normal(size=(5, 16, 3))
    ours = joint_angles(torch.from_numpy(pose), torch.from_numpy(axes)).numpy()
    for frame in range(5):
        for joint in range(15):
            matrix = Rotation.from_rotvec(pose[frame, joint + 1]).as_matrix()
            local = Rotation.from_matrix(axes[joint].T @ matrix @ axes[joint])
            np.testing.assert_allclose(ours[frame, joint], local.as_euler("XYZ"), atol=1e-10)


def test_angles_and_poses_are_inverse(hand: HandTemplate) -> None:
    axes = torch.from_numpy(joint_axes(hand))
    random = np.random.default_rng(1)
    angles = torch.from_numpy(random.uniform(-1.4, 1.4, size=(20, 15, 3)))
    pose = torch.zeros(20, 16, 3, dtype=torch.float64)
    pose[:, 1:] = pose_from_joint_angles(angles, axes)
    torch.testing.assert_close(joint_angles(pose, axes), angles, rtol=0, atol=1e-10)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("abduction", [90.0, -90.0])
def test_locked_joints_stay_finite_and_keep_their_rotation(
    free_right: HandTemplate, dtype: torch.dtype, abduction: float
) -> None:
    axes = torch.from_numpy(joint_axes(free_right)).to(dtype)
    angles = torch.zeros(1, 15, 3, dtype=dtype)
    angles[..., 0], angles[..., 1] = 0.4, np.deg2rad(abduction)
    pose = torch.zeros(1, 16, 3, dtype=dtype)
    pose[:, 1:] = pose_from_joint_angles(angles, axes)
    pose.requires_grad_()
    found = joint_angles(pose, axes)
    back = pose_from_joint_angles(found, axes)
    torch.testing.assert_close(back, pose[:, 1:], rtol=0, atol=2e-3)
    found.sum().backward()
    assert pose.grad is not None
    assert torch.isfinite(pose.grad).all()


def test_rest_pose_is_free_of_penalty_and_gradient(hand: HandTemplate) -> None:
    pose = torch.zeros(2, 16, 3, requires_grad=True)
    penalty = joint_limit_penalty(pose, hand)
    assert penalty.tolist() == [0.0, 0.0]
    penalty.sum().backward()
    assert pose.grad is not None
    assert not pose.grad.any()


def test_penalty_is_the_squared_excess(hand: HandTemplate) -> None:
    limits = anatomical_limits(hand)
    axes = torch.from_numpy(limits.axes)
    for joint, axis, excess in ((1, 0, 0.3), (4, 0, -0.2), (13, 1, 0.1), (9, 2, -0.25)):
        angles = torch.zeros(1, 15, 3, dtype=torch.float64)
        bound = limits.upper if excess > 0.0 else limits.lower
        angles[0, joint - 1, axis] = bound[joint - 1, axis] + excess
        pose = torch.zeros(1, 16, 3, dtype=torch.float64)
        pose[:, 1:] = pose_from_joint_angles(angles, axes)
        for template in (hand, limits):
            assert joint_limit_penalty(pose, template).item() == pytest.approx(excess**2, abs=1e-9)


def test_a_fist_is_inside_the_limits_and_a_broken_finger_is_not(hand: HandTemplate) -> None:
    axes = torch.from_numpy(joint_axes(hand))
    angles = torch.zeros(1, 15, 3, dtype=torch.float64)
    angles[0, :12, 0] = np.deg2rad(65.0)
    pose = torch.zeros(1, 16, 3, dtype=torch.float64)
    pose[:, 1:] = pose_from_joint_angles(angles, axes)
    assert joint_limit_penalty(pose, hand).item() == 0.0
    pose[:, 1:] = pose_from_joint_angles(-angles, axes)
    assert joint_limit_penalty(pose, hand).item() > 0.5


def test_penalty_gradients_agree_with_finite_differences(free_right: HandTemplate) -> None:
    limits = anatomical_limits(free_right)
    pose = torch.from_numpy(np.random.default_rng(2).normal(size=(1, 16, 3)) * 0.6)
    assert torch.autograd.gradcheck(
        lambda p: joint_limit_penalty(p, limits), (pose.requires_grad_(),)
    )


def test_a_skeleton_without_a_palm_is_refused(free_right: HandTemplate) -> None:
    with pytest.raises(BadHandModel, match="one line"):
        palm_directions(np.zeros((16, 3)), "right")
    joints = free_right.joints.copy()
    joints[2] = joints[1]
    with pytest.raises(BadHandModel, match="coincide"):
        joint_axes(rebuilt(free_right, joints=joints))
