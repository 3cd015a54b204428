"""How near the page's Gaussians come to the avatar's own drawing; and the still image."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np
import torch

from hwp_bench.capture import Capture
from hwp_bench.methods.contract import Camera, HandPose
from wildghand.avatar import WildGHandAvatar
from wildghand.gaussians.quaternions import matrix_to_quat
from wildghand.page.bake import BakedHand, PoseBasis
from wildghand.page.poses import PoseSamples
from wildghand.splat import rasterize

# Field of view of the still image, and how much of it the hand fills.
_FOCAL, _FILLED = 2.0, 0.8


@dataclass(frozen=True)
class Fidelity:
    """PSNR over the hand's box against `WildGHandAvatar.render`, dB; of the mean square error."""

    #: As the page draws: joints, and linear parts.
    baked: float
    #: Joints alone, with the mean of the rest.
    joints_only: float


def fidelity(
    avatar: WildGHandAvatar,
    capture: Capture,
    hands: Mapping[str, BakedHand],
    frames: Sequence[int],
) -> Fidelity | None:
    """Compare both forms with the avatar in frames of a capture; None without frames."""
    if not frames:
        return None
    fixed = {
        side: replace(hand, means=_mean_only(hand.means), colors=_mean_only(hand.colors))
        for side, hand in hands.items()
    }
    errors: dict[str, list[float]] = {"baked": [], "joints_only": []}
    for frame in frames:
        poses, camera = capture.hand_poses(frame), capture.camera(frame)
        poses = avatar.believed({side: poses[side] for side in avatar.sides})
        truth = avatar.render(poses, camera)
        seen = np.argwhere(truth[..., 3] > 0.5)
        if not len(seen):
            continue
        box = tuple(slice(a, b + 1) for a, b in zip(seen.min(0), seen.max(0), strict=True))
        for name, form in (("baked", hands), ("joints_only", fixed)):
            drawn = draw_baked(form, poses, camera)
            errors[name].append(float(np.square(drawn[box] - truth[..., :3][box]).mean()))
    if not errors["baked"]:
        return None
    return Fidelity(
        **{
            name: round(float(-10.0 * np.log10(np.mean(e) + 1e-12)), 2)
            for name, e in errors.items()
        }
    )


def draw_baked(
    hands: Mapping[str, BakedHand], poses: Mapping[str, HandPose], camera: Camera
) -> np.ndarray:
    """(H, W, 3) sRGB over black of baked hands, by the project's own rasterizer."""
    parts = [hand.posed(poses[side].pose, poses[side].transl) for side, hand in hands.items()]
    means, covariances, colors = (np.concatenate(column) for column in zip(*parts, strict=True))
    power, axes = np.linalg.eigh(covariances)
    axes[np.linalg.det(axes) < 0.0, :, 0] *= -1.0

    def single(array: np.ndarray) -> torch.Tensor:
        return torch.as_tensor(np.asarray(array), dtype=torch.float32)

    image, _, _ = rasterize(
        single(means),
        matrix_to_quat(single(axes)),
        single(np.sqrt(power.clip(min=0.0))),
        single(np.concatenate([hand.opacities for hand in hands.values()])),
        single(colors),
        single(camera.viewmat)[None],
        single(camera.K)[None],
        camera.width,
        camera.height,
    )
    return image[0].clamp(0.0, 1.0).numpy()


def still_image(avatar: WildGHandAvatar, samples: PoseSamples, size: int) -> bytes:
    """PNG with transparency of the hands at the start, from the camera's side."""
    poses = {side: samples.start[side] for side in avatar.sides}
    means = avatar.pose(poses).means
    centre = (means.min(axis=0) + means.max(axis=0)) / 2.0
    radius = float(np.linalg.norm(means - centre, axis=1).max())
    viewmat = samples.viewmat.copy()
    viewmat[:3, 3] = [0.0, 0.0, radius * _FOCAL * 2.0 / _FILLED] - viewmat[:3, :3] @ centre
    K = np.array([[_FOCAL * size, 0, size / 2], [0, _FOCAL * size, size / 2], [0, 0, 1]])
    rgba = avatar.render(poses, Camera(K, viewmat, size, size))
    straight = rgba[..., :3] / np.maximum(rgba[..., 3:], 1e-6)
    whole = np.concatenate([straight[..., ::-1], rgba[..., 3:]], axis=-1).clip(0.0, 1.0)
    return bytes(cv2.imencode(".png", np.rint(whole * 255.0).astype(np.uint8))[1])


def _mean_only(basis: PoseBasis) -> PoseBasis:
    return replace(basis, steps=np.zeros_like(basis.steps))
