"""Projection against OpenCV's projectPoints (1e-10) and finite differences."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from hwp_bench.base.errors import ShapeMismatch
from hwp_bench.hands import project


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


def test_a_point_on_the_optical_axis_is_the_principal_point() -> None:
    pixels, depth = project(
        torch.tensor([[[0.0, 0.0, 2.0]]]), torch.eye(4)[None], cameras(1)[1].float()
    )
    np.testing.assert_allclose(pixels, [[[128.0, 100.5]]])
    assert depth.item() == 2.0


def test_points_in_the_cameras_plane_stay_finite() -> None:
    points = torch.tensor([[[0.1, 0.2, 0.0], [0.0, 0.0, 0.0]]], requires_grad=True)
    pixels, _ = project(points, torch.eye(4)[None], cameras(1)[1].float())
    assert torch.isfinite(pixels).all()
    pixels.sum().backward()
    assert points.grad is not None
    assert torch.isfinite(points.grad).all()


def test_gradients_agree_with_finite_differences() -> None:
    viewmats, intrinsics = cameras(2)
    points = torch.from_numpy(np.random.default_rng(2).normal(size=(2, 3, 3)) * 0.3)
    inputs = tuple(x.clone().requires_grad_() for x in (points, viewmats, intrinsics))
    assert torch.autograd.gradcheck(project, inputs)


@pytest.mark.parametrize("field", ["points", "viewmats", "Ks"])
def test_wrong_shapes_are_named(field: str) -> None:
    inputs = {
        "points": torch.zeros(2, 5, 3),
        "viewmats": torch.zeros(2, 4, 4),
        "Ks": torch.zeros(2, 3, 3),
    }
    inputs[field] = torch.zeros(2, 3, 2)
    with pytest.raises(ShapeMismatch) as caught:
        project(**inputs)
    assert caught.value.field == field
