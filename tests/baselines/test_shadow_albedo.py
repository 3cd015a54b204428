"""One lamp and its shadows. Oracles: plates in closed form; rays through the posed mesh."""

from __future__ import annotations

import math
from collections import Counter
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from fitted_parts import scores_of
from formed import formed_capture, over, training_of
from painted import (
    FRAMES,
    QUICK,
    SIZE,
    cameras,
    hand_parameters,
    painted_avatar,
)

from hwp_bench.hands import pose_hand
from hwp_bench.hands.skeleton import HandParameters
from hwp_bench.sim.geometry.surface import Tracer
from plain_fit.method import PlainMethod
from shadow_albedo_fit.method import ShadowedModel, ShadowMethod, lamp_cameras, visibility
from wildghand.gaussians.quaternions import quat_third_axis
from wildghand.gaussians.rig import AnchorPoses, HandRig
from wildghand.plain.model import PlainModel

AMBIENT = 0.35
LAMP = np.array([0.9, -0.7, 0.1])


def bent_hand() -> HandParameters:
    """A hand that turns by half a radian and bends its fingers, so that its shadows move."""
    hand = hand_parameters("right", 4)
    pose = hand.pose.copy()
    pose[:, 1:] *= 2.5
    pose[:, 0] = [math.pi / 2, 0.0, 0.0] + 3.5 * (pose[:, 0] - [math.pi / 2, 0.0, 0.0])
    return replace(hand, pose=pose)


def posed(rig: HandRig, hand: HandParameters, frame: int) -> tuple[AnchorPoses, np.ndarray]:
    """The anchors of one frame, and the mesh's vertices."""

    def tensor(array: np.ndarray) -> torch.Tensor:
        return torch.as_tensor(array, dtype=torch.float32)

    given = tensor(hand.pose[frame : frame + 1]), tensor(hand.betas)
    transl = tensor(hand.transl[frame : frame + 1])
    mesh = pose_hand(rig.template, *given, transl).vertices[0].numpy()
    return rig.pose(*given, transl), mesh


def seen_by_rays(rig: HandRig, poses: AnchorPoses, mesh: np.ndarray) -> np.ndarray:
    """(N,) bool, whether nothing but the skin around an anchor is between it and the lamp."""
    points = poses.positions[0].double().numpy()
    towards = LAMP - points
    towards /= np.linalg.norm(towards, axis=1, keepdims=True)
    tracer = Tracer(mesh.astype(np.float64), rig.template.faces.numpy(), Counter())
    return ~tracer.blocked(points + 0.004 * towards, towards, "shadow")


def shading_by_rays(rig: HandRig, poses: AnchorPoses, mesh: np.ndarray) -> np.ndarray:
    """(N,) the light at each anchor."""
    normals = quat_third_axis(poses.orientations)[0].double().numpy()
    towards = LAMP - poses.positions[0].double().numpy()
    towards /= np.linalg.norm(towards, axis=1, keepdims=True)
    facing = np.maximum(0.0, (normals * towards).sum(axis=1))
    return AMBIENT + (1.0 - AMBIENT) * facing * seen_by_rays(rig, poses, mesh)


def plates(gap: float, half: int = 20) -> AnchorPoses:
    """A plate of 4 cm at z = 0 and one of a quarter of its area `gap` above it; both face up."""
    step = 0.02 / half
    x, y = np.meshgrid(*[(np.arange(-half, half) + 0.5) * step] * 2)
    below = np.stack([x, y, 0.0 * x], axis=-1).reshape(-1, 3)
    inner = below[(np.abs(below[:, :2]) < 0.01).all(axis=1)]
    points = np.concatenate([below, inner + np.array([0.0, 0.0, gap])])
    quats = np.tile([1.0, 0.0, 0.0, 0.0], (len(points), 1))
    as_tensor = (torch.as_tensor(one[None], dtype=torch.float32) for one in (points, quats))
    return AnchorPoses(*as_tensor)


def test_a_plate_shades_the_plate_below_it() -> None:
    """From straight above the shadow is the upper plate's outline, but for two pixels around it."""
    poses = plates(0.03)
    seen = visibility(poses, torch.tensor([0.0, 0.0, 1.5]), 0.001, 128)[0]
    reach = poses.positions[0, :1600, :2].abs().amax(dim=1)
    assert seen[:1600][reach < 0.0085].max() < 0.02
    assert seen[:1600][reach > 0.0125].min() > 0.98
    assert seen[1600:].min() > 0.98


def test_skin_does_not_shade_itself() -> None:
    """A gap below the bias of 8 mm casts no shadow."""
    seen = visibility(plates(0.004), torch.tensor([0.0, 0.0, 1.5]), 0.001, 128)
    assert seen.min() > 0.9


def test_the_lamp_s_camera_holds_all_points() -> None:
    points = torch.randn(3, 200, 3) * 0.05 + torch.tensor([0.1, 0.2, 0.5])
    lamp = torch.tensor([1.0, -2.0, 0.3])
    viewmats, Ks = lamp_cameras(points, lamp, 100)
    torch.testing.assert_close(
        viewmats[:, :3, :3] @ viewmats[:, :3, :3].mT, torch.eye(3).expand(3, 3, 3)
    )
    assert torch.linalg.det(viewmats[:, :3, :3]).min() > 0.99
    seen = (points @ viewmats[:, :3, :3].mT + viewmats[:, None, :3, 3]) @ Ks.mT
    pixels = seen[..., :2] / seen[..., 2:]
    assert 0.0 < pixels.min() < pixels.max() < 100.0
    # The lamp itself lies on the view's axis, behind or at the eye.
    in_camera = viewmats[:, :3, :3] @ lamp + viewmats[:, :3, 3]
    assert in_camera[:, :2].abs().max() < 1e-5


def test_the_shadows_of_a_hand_are_those_of_rays() -> None:
    """Of the anchors that face the lamp, nine in ten agree; shadows are soft, rays are not."""
    rig = next(iter(painted_avatar(("right",)).model.rigs.values()))
    agree, shaded = [], []
    for frame in (0, 5, 9):
        poses, mesh = posed(rig, bent_hand(), frame)
        lamp = torch.as_tensor(LAMP, dtype=torch.float32)
        soft = visibility(poses, lamp, rig.spacing, 256)[0].numpy()
        hard = seen_by_rays(rig, poses, mesh)
        towards = LAMP - poses.positions[0].numpy()
        faces = (quat_third_axis(poses.orientations)[0].numpy() * towards).sum(axis=1) > 0.3
        agree.append(((soft > 0.5) == hard)[faces].mean())
        shaded.append(1.0 - hard[faces].mean())
    assert min(agree) > 0.9, agree
    assert max(shaded) > 0.05, shaded


def test_shading_and_its_gradient_are_those_of_the_formula() -> None:
    """a + (1 - a) max(0, n . l) in float64, and its derivatives by differences."""
    normal_model = painted_avatar(("right",)).model
    poses, _ = posed(normal_model.rigs["right"], bent_hand(), 3)
    lamp = torch.tensor(LAMP, dtype=torch.float64, requires_grad=True)
    logit = torch.tensor(0.3, dtype=torch.float64, requires_grad=True)
    model = ShadowedModel(**vars(normal_model), lamp=lamp, logit_ambient=logit, shadow_size=0)
    exact = AnchorPoses(poses.positions[:, ::50].double(), poses.orientations[:, ::50].double())

    def shading(lamp: torch.Tensor, logit: torch.Tensor) -> torch.Tensor:
        return replace(model, lamp=lamp, logit_ambient=logit).shading(exact)

    assert torch.autograd.gradcheck(shading, (lamp, logit))
    ambient = 1.0 / (1.0 + math.exp(-0.3))
    towards = LAMP - exact.positions[0].numpy()
    towards /= np.linalg.norm(towards, axis=1, keepdims=True)
    normals = quat_third_axis(exact.orientations)[0].numpy()
    expected = ambient + (1.0 - ambient) * np.maximum(0.0, (normals * towards).sum(axis=1))
    np.testing.assert_allclose(shading(lamp, logit)[0].detach().numpy(), expected, rtol=1e-12)


@pytest.mark.slow
def test_shadows_that_move_with_the_pose_are_predicted(tmp_path: Path) -> None:
    """A hand lit from one side, shaded by rays through its mesh.

    The plain fit, whose light of nine coefficients knows no shadow, must miss by 1 dB at least
    what the fit with shadows reaches in poses that it has not seen.
    """
    model, hand, clip = painted_avatar(("right",)).model, bent_hand(), cameras()
    rig = model.rigs["right"]

    def picture(frame: int) -> tuple[np.ndarray, np.ndarray]:
        poses, mesh = posed(rig, hand, frame)
        light = torch.as_tensor(shading_by_rays(rig, poses, mesh), dtype=torch.float32)
        rgba = drawing(model, model.gaussians.logit_colors.sigmoid() * light[:, None], poses, frame)
        return over(rgba), rgba[..., 3] > 0.5

    def drawing(
        model: PlainModel, colors: torch.Tensor, poses: AnchorPoses, frame: int
    ) -> np.ndarray:
        view = torch.as_tensor(clip.viewmats[frame : frame + 1], dtype=torch.float32)
        K = torch.as_tensor(clip.Ks[frame : frame + 1], dtype=torch.float32)
        image, cover = model.rasterized(colors[None], poses, view, K, SIZE, SIZE)
        return torch.cat((image, cover), dim=-1)[0].double().numpy()

    with torch.no_grad():
        capture = formed_capture(tmp_path / "lit", hand, picture)
    assert capture.info.frame_count == FRAMES
    training = training_of(capture, tmp_path / "request")
    settings = {**QUICK, "gaussians": 1200, "steps": 160}
    methods = (
        PlainMethod(settings, 0),
        ShadowMethod(settings, 0),
        ShadowMethod({**settings, "shadows": False}, 0),
    )
    scores = scores_of(training, capture, *methods)
    assert scores[1] > scores[0] + 1.0, scores
    assert scores[1] > scores[2] + 0.5, scores
