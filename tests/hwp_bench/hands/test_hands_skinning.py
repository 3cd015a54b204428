"""Skinning against a slow float64 loop written from the definition (1e-12; float32 1e-5)."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from hwp_bench.base.errors import ShapeMismatch
from hwp_bench.hands import HandTemplate, landmark_order, mirror_template, pose_hand, project


def slow_pose(
    template: HandTemplate, pose: np.ndarray, betas: np.ndarray, transl: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """One frame: vertices and joints, joint by joint and vertex by vertex."""
    rest_joints = template.joints + template.joint_basis @ betas
    rest = template.vertices + template.shape_basis @ betas
    rotations = Rotation.from_rotvec(pose).as_matrix()
    if template.pose_basis is not None:
        rest = rest + template.pose_basis @ (rotations[1:] - np.eye(3)).reshape(-1)
    world = []
    for joint, parent in enumerate(template.parents):
        local = np.eye(4)
        local[:3, :3] = rotations[joint]
        local[:3, 3] = rest_joints[joint] - (rest_joints[parent] if parent >= 0 else 0.0)
        world.append(local if parent < 0 else world[parent] @ local)
    joints = np.array([motion[:3, 3] for motion in world])
    vertices = np.zeros_like(rest)
    for i, vertex in enumerate(rest):
        for joint in range(16):
            moved = world[joint][:3, :3] @ (vertex - rest_joints[joint]) + joints[joint]
            vertices[i] += template.weights[i, joint] * moved
    return vertices + transl, joints + transl


def random_parameters(frames: int, seed: int = 0) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    random = np.random.default_rng(seed)
    return (
        0.8 * random.normal(size=(frames, 16, 3)),
        random.normal(size=(frames, 10)),
        random.normal(size=(frames, 3)),
    )


@pytest.mark.parametrize(("dtype", "tolerance"), [(torch.float64, 1e-12), (torch.float32, 1e-5)])
def test_posing_agrees_with_the_slow_loop(
    tiny_template: HandTemplate, dtype: torch.dtype, tolerance: float
) -> None:
    pose, betas, transl = random_parameters(3)
    tensors = tiny_template.to_torch(dtype)
    posed = pose_hand(tensors, *(torch.tensor(x, dtype=dtype) for x in (pose, betas, transl)))
    for frame in range(3):
        vertices, joints = slow_pose(tiny_template, pose[frame], betas[frame], transl[frame])
        np.testing.assert_allclose(posed.vertices[frame], vertices, atol=tolerance)
        np.testing.assert_allclose(posed.joints[frame], joints, atol=tolerance)


def test_zero_pose_is_the_shaped_rest_mesh(tiny_template: HandTemplate) -> None:
    betas = np.random.default_rng(3).normal(size=10)
    posed = pose_hand(
        tiny_template.to_torch(torch.float64),
        torch.zeros(1, 16, 3, dtype=torch.float64),
        torch.from_numpy(betas),
        torch.zeros(1, 3, dtype=torch.float64),
    )
    expected = tiny_template.vertices + tiny_template.shape_basis @ betas
    np.testing.assert_allclose(posed.vertices[0], expected, atol=1e-14)
    identity = np.broadcast_to(np.eye(4), (1, 16, 4, 4))
    np.testing.assert_allclose(posed.transforms, identity, atol=1e-14)


def test_the_root_turns_about_the_wrist_before_the_translation(
    tiny_template: HandTemplate,
) -> None:
    pose, betas, transl = (torch.from_numpy(x) for x in random_parameters(2))
    posed = pose_hand(tiny_template.to_torch(torch.float64), pose, betas, transl)
    rest_wrist = tiny_template.joints[0] + betas.numpy() @ tiny_template.joint_basis[0].T
    np.testing.assert_allclose(posed.joints[:, 0], rest_wrist + transl.numpy(), atol=1e-14)


def test_transforms_carry_rest_joints_to_posed_joints(tiny_template: HandTemplate) -> None:
    pose, betas, transl = (torch.from_numpy(x) for x in random_parameters(2))
    posed = pose_hand(tiny_template.to_torch(torch.float64), pose, betas, transl)
    rest = tiny_template.joints + np.einsum("jck,bk->bjc", tiny_template.joint_basis, betas)
    rest = np.concatenate([rest, np.ones((2, 16, 1))], axis=-1)
    moved = np.einsum("bjik,bjk->bji", posed.transforms.numpy(), rest)
    np.testing.assert_allclose(moved[..., :3], posed.joints, atol=1e-13)


def test_mean_pose_is_added_to_the_fingers_only_when_asked_for(
    tiny_template: HandTemplate,
) -> None:
    pose, betas, transl = (torch.from_numpy(x) for x in random_parameters(2))
    tensors = tiny_template.to_torch(torch.float64)
    relative = pose_hand(tensors, pose, betas, transl, flat_hand_mean=False)
    absolute = pose.clone()
    absolute[:, 1:] += torch.from_numpy(tiny_template.mean_pose).reshape(15, 3)
    expected = pose_hand(tensors, absolute, betas, transl)
    torch.testing.assert_close(relative.vertices, expected.vertices, rtol=0, atol=1e-14)


def test_landmarks_run_from_the_wrist_through_thumb_to_little_finger(
    free_right: HandTemplate,
) -> None:
    pose, betas, transl = (torch.from_numpy(x) for x in random_parameters(1))
    posed = pose_hand(free_right.to_torch(torch.float64), pose, betas, transl)
    middle = posed.landmarks[0, 9:13]
    torch.testing.assert_close(middle[:3], posed.joints[0, 4:7])
    torch.testing.assert_close(middle[3], posed.vertices[0, free_right.fingertips[2]])
    torch.testing.assert_close(posed.landmarks[0, 1:4], posed.joints[0, 13:16])
    torch.testing.assert_close(posed.landmarks[0, 20], posed.vertices[0, free_right.fingertips[4]])
    assert sorted(landmark_order()) == list(range(21))


@pytest.mark.parametrize("scale", [0.0, 0.5])
def test_gradients_agree_with_finite_differences(tiny_template: HandTemplate, scale: float) -> None:
    pose, betas, transl = (torch.from_numpy(scale * x) for x in random_parameters(2, seed=4))
    tensors = tiny_template.to_torch(torch.float64)

    def positions(*inputs: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        posed = pose_hand(tensors, *inputs, flat_hand_mean=scale > 0.0)
        return posed.vertices, posed.transforms

    inputs = tuple(x.requires_grad_() for x in (pose, betas, transl))
    assert torch.autograd.gradcheck(positions, inputs)


def test_mirrored_parameters_pose_the_mirrored_hand(
    tiny_template: HandTemplate, free_right: HandTemplate
) -> None:
    axial, polar = torch.tensor([1.0, -1.0, -1.0]), torch.tensor([-1.0, 1.0, 1.0])
    for template in (tiny_template, free_right):
        pose, betas, transl = (torch.from_numpy(x) for x in random_parameters(2, seed=6))
        right = pose_hand(template.to_torch(torch.float64), pose, betas, transl)
        left = pose_hand(
            mirror_template(template).to_torch(torch.float64), pose * axial, betas, transl * polar
        )
        torch.testing.assert_close(left.vertices, right.vertices * polar, rtol=0, atol=1e-12)
        torch.testing.assert_close(left.landmarks, right.landmarks * polar, rtol=0, atol=1e-12)


@pytest.mark.parametrize("field", ["pose", "betas", "transl"])
def test_wrong_shapes_are_named(tiny_template: HandTemplate, field: str) -> None:
    shapes = {"pose": (2, 16, 3), "betas": (2, 10), "transl": (2, 3)}
    shapes[field] = (*shapes[field][:-1], 4)
    inputs = {name: torch.zeros(shape) for name, shape in shapes.items()}
    with pytest.raises(ShapeMismatch) as caught:
        pose_hand(tiny_template.to_torch(), **inputs)
    assert caught.value.field == field


def cameras(frames: int) -> tuple[torch.Tensor, torch.Tensor]:
    random = np.random.default_rng(0)
    viewmats = np.tile(np.eye(4), (frames, 1, 1))
    viewmats[:, :3, :3] = Rotation.random(frames, rng=random).as_matrix()
    viewmats[:, :3, 3] = [0.1, -0.2, 3.0]
    intrinsics = np.array([[500.0, 0.0, 128.0], [0.0, 480.0, 100.5], [0.0, 0.0, 1.0]])
    return torch.from_numpy(viewmats), torch.from_numpy(intrinsics).expand(frames, -1, -1)


def test_pixels_agree_with_opencv() -> None:
    viewmats, intrinsics = cameras(4)
    points = torch.from_numpy(np.random.default_rng(1).normal(size=(4, 20, 3)))
    pixels, depth = project(points, viewmats, intrinsics)
    for frame in range(4):
        motion = viewmats[frame].numpy()
        expected, _ = cv2.projectPoints(
            points[frame].numpy(),
            cv2.Rodrigues(motion[:3, :3])[0],
            motion[:3, 3],
            intrinsics[frame].numpy(),
            None,
        )
        in_front = depth[frame].numpy() > 0.1
        assert in_front.sum() > 10
        np.testing.assert_allclose(pixels[frame][in_front], expected[in_front, 0], rtol=1e-8)
        in_camera = points[frame].numpy() @ motion[:3, :3].T + motion[:3, 3]
        np.testing.assert_allclose(depth[frame], in_camera[:, 2], atol=1e-12)


def test_points_in_the_cameras_plane_stay_finite() -> None:
    points = torch.tensor([[[0.1, 0.2, 0.0], [0.0, 0.0, 0.0]]], requires_grad=True)
    pixels, _ = project(points, torch.eye(4)[None], cameras(1)[1].float())
    assert torch.isfinite(pixels).all()
    pixels.sum().backward()
    assert points.grad is not None
    assert torch.isfinite(points.grad).all()


def test_gradients_of_pixels_agree_with_finite_differences() -> None:
    viewmats, intrinsics = cameras(2)
    points = torch.from_numpy(np.random.default_rng(2).normal(size=(2, 3, 3)) * 0.3)
    inputs = tuple(x.clone().requires_grad_() for x in (points, viewmats, intrinsics))
    assert torch.autograd.gradcheck(project, inputs)


@pytest.mark.parametrize("field", ["points", "viewmats", "Ks"])
def test_wrong_shapes_of_cameras_are_named(field: str) -> None:
    inputs = {
        "points": torch.zeros(2, 5, 3),
        "viewmats": torch.zeros(2, 4, 4),
        "Ks": torch.zeros(2, 3, 3),
    }
    inputs[field] = torch.zeros(2, 3, 2)
    with pytest.raises(ShapeMismatch) as caught:
        project(**inputs)
    assert caught.value.field == field
