"""Motion for an exported mesh: a capture's, or fingers that close and open."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
import torch

from hwp_bench.base.errors import UsageError
from hwp_bench.capture import Capture
from hwp_bench.hands import HandTemplate
from hwp_bench.hands.articulation import joint_axes, pose_from_joint_angles
from hwp_bench.methods.contract import HandPose
from wildghand.avatar import WildGHandAvatar

#: Length and rate of the motion that needs no capture.
SECONDS, FPS = 2.0, 24.0
# Flexion of the closed hand at the three joints of a finger and of the thumb, degrees.
_FINGER, _THUMB = (60.0, 75.0, 45.0), (10.0, 30.0, 35.0)


@dataclass(frozen=True, eq=False)
class Motion:
    """Poses of one or two hands over time."""

    #: (T,) s, rising from 0.
    times: np.ndarray
    #: By side: (T, 16, 3) axis-angle, rad.
    poses: Mapping[str, np.ndarray]
    #: By side: (T, 3) m.
    transls: Mapping[str, np.ndarray]
    #: Whether y points down, as in captures, and not up, as at rest.
    down: bool


def capture_motion(avatar: WildGHandAvatar, capture: Capture, sides: tuple[str, ...]) -> Motion:
    """Return the motion of a capture; frames in which a hand was not found are left out.

    Args:
        avatar: what moves, in the poses that it believes in.
        capture: whose hand parameters are taken.
        sides: the hands.

    Raises:
        UsageError: no frame shows all of the hands.
    """
    hands = {side: capture.hands[side] for side in sides}
    kept = np.flatnonzero(np.all([hand.valid for hand in hands.values()], axis=0))
    if not len(kept):
        raise UsageError("has no frame in which all hands were found", where=capture.root)
    frames = [
        avatar.believed({side: hand.at(frame, side) for side, hand in hands.items()})
        for frame in kept.tolist()
    ]
    return Motion(
        times=(kept - kept[0]) / capture.info.fps,
        poses={side: np.stack([frame[side].pose for frame in frames]) for side in sides},
        transls={side: np.stack([frame[side].transl for frame in frames]) for side in sides},
        down=True,
    )


def closing_motion(templates: Mapping[str, HandTemplate], rest: Mapping[str, HandPose]) -> Motion:
    """Return a motion in which the fingers close and open once.

    Args:
        templates: by side.
        rest: where the hands lie.
    """
    times = np.arange(round(SECONDS * FPS) + 1) / FPS
    share = 0.5 - 0.5 * np.cos(2.0 * math.pi * times / SECONDS)
    flexion = np.radians([*(4 * _FINGER), *_THUMB])
    angles = np.zeros((len(times), 15, 3))
    angles[..., 0] = share[:, None] * flexion
    poses, transls = {}, {}
    for side, template in templates.items():
        axes = torch.from_numpy(joint_axes(template))
        poses[side] = np.zeros((len(times), 16, 3))
        poses[side][:, 1:] = pose_from_joint_angles(torch.from_numpy(angles), axes).numpy()
        transls[side] = np.tile(rest[side].transl, (len(times), 1))
    return Motion(times, poses, transls, down=False)
