"""The poses of a page: those that are baked, those that are played, and what moves the joints."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch

from hwp_bench.base.arrays import evenly
from hwp_bench.base.errors import UsageError
from hwp_bench.capture import Capture
from hwp_bench.hands import anatomical_limits, load_template, pose_from_joint_angles
from hwp_bench.methods.contract import HandPose
from wildghand.avatar import WildGHandAvatar
from wildghand.avatar.playback import shown_sides
from wildghand.page.settings import PageSettings

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
    """Choose poses.

    Raises:
        UsageError: the capture is of other hands, of another hand model, or not what was fitted.
    """
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
