"""What a page holds: its poses, controls and still image, and how near it comes to the avatar."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import cv2
import numpy as np
import torch

from hwp_bench.base.arrays import evenly
from hwp_bench.base.errors import UsageError
from hwp_bench.capture import Capture
from hwp_bench.hands import anatomical_limits, load_template, pose_from_joint_angles
from hwp_bench.methods.contract import Camera, HandPose
from wildghand.avatar import WildGHandAvatar
from wildghand.avatar.render import shown_sides
from wildghand.evidence.count import seen_anchors
from wildghand.gaussians.quaternions import matrix_to_quat
from wildghand.page.bake import BakedHand, PoseBasis
from wildghand.splat import rasterize


@dataclass(frozen=True)
class PageSettings:
    """How much of the avatar a page holds."""

    #: Principal components of places and of colours that depend on the pose.
    geometry_rank: int = 6
    color_rank: int = 12
    #: Principal components of the biases of the frames that are played; 0: pages cannot show them.
    bias_rank: int = 4
    #: Poses of the clip, and random ones within the limits of the joints, that are drawn to bake.
    clip_samples: int = 80
    random_samples: int = 48
    #: Most training frames whose motion is played.
    most_frames: int = 240
    #: Edge of the still image for browsers without WebGL2, px.
    still_size: int = 384
    #: Of the random poses.
    seed: int = 0


# Each fourth frame at most is kept out of what is baked, this many at most.
_HELD_OUT = 8


@dataclass(frozen=True, eq=False)
class PoseSamples:
    """Poses of an avatar's hands."""

    #: (P, 16, 3) rad by side: the pose at the start, poses of the clip, random ones.
    baked: Mapping[str, np.ndarray]
    #: The hands when the page is opened.
    start: Mapping[str, HandPose]
    #: Frames that are played, and (F, 51) their poses and translations by side.
    frames: list[int]
    motion: Mapping[str, np.ndarray]
    #: Frames that were not baked, to measure with.
    held_out: list[int]
    #: (4, 4) of the camera at the start.
    viewmat: np.ndarray
    #: Frames a second.
    fps: float


def sample_poses(
    avatar: WildGHandAvatar, capture: Capture | None, settings: PageSettings
) -> PoseSamples:
    """Choose poses."""
    random = np.random.default_rng(settings.seed)
    if capture is None:
        # In the studio, where the light is as frames have shown it.
        start = avatar.studio.posed()
        clip = {side: start[side].pose[None] for side in avatar.sides}
        frames, held_out, viewmat, fps = [], [], np.eye(4), 30.0
        motion = {side: np.zeros((0, 51)) for side in avatar.sides}
    else:
        _check(avatar, capture)
        fitted = [frame for frame in avatar.record.frames if _shown(avatar, capture, frame)]
        if not fitted:
            raise UsageError("has no fitted frame that shows every hand", where=capture.root)
        frames = [fitted[pick] for pick in evenly(len(fitted), settings.most_frames)]
        held_out = [fitted[pick] for pick in evenly(len(fitted), _HELD_OUT + 2)[1:-1]]
        rest = [frame for frame in fitted if frame not in held_out] or fitted
        drawn = [rest[pick] for pick in evenly(len(rest), settings.clip_samples)]
        start = avatar.believed(capture.hand_poses(fitted[0]))
        clip, motion = {}, {}
        for side in avatar.sides:
            poses = {f: avatar.believed(capture.hand_poses(f))[side] for f in fitted}
            clip[side] = np.stack([start[side].pose, *(poses[frame].pose for frame in drawn)])
            motion[side] = np.stack(
                [np.append(poses[frame].pose.ravel(), poses[frame].transl) for frame in frames]
            )
        viewmat, fps = capture.camera(fitted[0]).viewmat, float(capture.info.fps)
    baked = {
        side: np.concatenate([poses, _random(avatar, side, poses, settings.random_samples, random)])
        for side, poses in clip.items()
    }
    return PoseSamples(baked, start, frames, motion, held_out, viewmat, fps)


def hand_controls(avatar: WildGHandAvatar, side: str) -> dict[str, Any]:
    """Axes and ranges (degrees) of the 15 finger joints, for the page's sliders."""
    limits = anatomical_limits(load_template(avatar.hand_model.source, side))
    return {
        "axes": limits.axes.tolist(),
        "lower": np.rad2deg(limits.lower).round(1).tolist(),
        "upper": np.rad2deg(limits.upper).round(1).tolist(),
    }


def _random(
    avatar: WildGHandAvatar, side: str, clip: np.ndarray, count: int, random: np.random.Generator
) -> np.ndarray:
    """(count, 16, 3) poses within the limits of the joints; the wrist is as in the clip."""
    limits = anatomical_limits(load_template(avatar.hand_model.source, side))
    share = random.uniform(0.2, 1.0, (count, 1, 1))
    angles = share * random.uniform(limits.lower, limits.upper, (count, 15, 3))
    fingers = pose_from_joint_angles(torch.as_tensor(angles), torch.as_tensor(limits.axes))
    wrists = clip[random.integers(0, len(clip), count), :1]
    return np.concatenate([wrists, fingers.numpy()], axis=1)


def _check(avatar: WildGHandAvatar, capture: Capture) -> None:
    if len(shown_sides(avatar, capture)) < len(avatar.sides):
        raise UsageError(
            f"shows the {capture.info.hands} hand alone, the avatar has two", where=capture.root
        )
    origin, fitted = avatar.record.source.get("capture"), avatar.record.frames
    if origin not in (None, capture.info.id) or not fitted or max(fitted) >= len(capture):
        raise UsageError(
            f"is {capture.info.id!r}, the avatar was fitted to {str(origin)[:100]!r}",
            where=capture.root,
        )


def _shown(avatar: WildGHandAvatar, capture: Capture, frame: int) -> bool:
    return all(bool(capture.hands[side].valid[frame]) for side in avatar.sides)


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


@torch.no_grad()
def mean_weights(
    avatar: WildGHandAvatar, capture: Capture, masks: Mapping[int, np.ndarray]
) -> dict[str, np.ndarray]:
    """Average weight masks over the frames that show each Gaussian's anchor.

    Args:
        masks: (H, W) uint8 weights of some training frames, 255 = full weight.

    Returns:
        (N,) by side, in [0, 1]; NaN where no frame of `masks` shows the anchor. Empty without
        masks.
    """
    rigs = avatar.model.rigs
    sums = {side: np.zeros((2, len(rig))) for side, rig in rigs.items()}
    for frame, mask in masks.items():
        hands, camera = capture.hand_poses(frame), capture.camera(frame)
        given = avatar.posed({side: hands[side] for side in rigs})
        anchors = {side: rigs[side].pose(*values) for side, values in given.items()}
        viewmat, K = (torch.as_tensor(m, dtype=torch.float32) for m in (camera.viewmat, camera.K))
        size = torch.Size((camera.height, camera.width))
        shown = seen_anchors(anchors, viewmat[None], K[None], size)
        for side, (pixels, facing) in shown.items():
            # Masks have the size of the frame, unless a person has made them smaller.
            scale = np.array(mask.shape[::-1]) / (camera.width, camera.height)
            x, y = (pixels[0].cpu().numpy() * scale - 0.5).astype(np.float32).T
            weight = cv2.remap(mask, x[None], y[None], cv2.INTER_LINEAR)[0] / 255.0
            counts = (facing[0] > 0.0).cpu().numpy()
            sums[side] += counts * np.stack([weight, np.ones_like(weight)])
    if not masks:
        return {}
    with np.errstate(invalid="ignore"):
        return {side: total / count for side, (total, count) in sums.items()}
