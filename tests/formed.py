"""Painted captures whose images are formed in other ways: hidden, lit from a side, or in motion."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path

import numpy as np
from painted import FRAMES, SIZE, cameras, painted_info

from hwp_bench.base.images import as_uint8
from hwp_bench.capture import Capture, CaptureWriter
from hwp_bench.capture.folder import open_capture
from hwp_bench.capture.splits import contiguous_split
from hwp_bench.hands.skeleton import HandParameters
from hwp_bench.methods.contract import Avatar, Budget, HandPose, RunSettings, TrainingCapture
from hwp_bench.methods.request import open_request, write_request

#: Draws a frame: (SIZE, SIZE, 3) sRGB in [0, 1], and its mask, (SIZE, SIZE) bool.
Picture = Callable[[int], tuple[np.ndarray, np.ndarray]]
#: sRGB behind the hand.
BEHIND = 0.35


def formed_capture(path: Path, hand: HandParameters, picture: Picture) -> Capture:
    """Write a capture of a right hand whose frames a function draws."""
    info = painted_info(path.name)
    with CaptureWriter(path, info, {"right": hand}, cameras()) as writer:
        for frame in range(FRAMES):
            image, mask = picture(frame)
            writer.frame(frame, as_uint8(image))
            writer.mask(frame, np.where(mask, 255, 0).astype(np.uint8))
    return open_capture(path)


def training_of(capture: Capture, path: Path) -> TrainingCapture:
    """What a method is given of a capture."""
    split = contiguous_split(capture.info.id, FRAMES)
    return open_request(write_request(path, capture, split, RunSettings({}, 0, Budget())))


def train_frames() -> frozenset[int]:
    """The frames that methods are fitted to."""
    return frozenset(contiguous_split("any", FRAMES).train.tolist())


def drawn(avatar: Avatar, pose: np.ndarray, hand: HandParameters, transl: np.ndarray) -> np.ndarray:
    """An avatar in a pose before the capture's camera: (SIZE, SIZE, 4) premultiplied."""
    hands: Mapping[str, HandPose] = {"right": HandPose("right", pose, hand.betas, transl)}
    return avatar.render(hands, cameras().camera(0, SIZE, SIZE)).astype(np.float64)


def over(rgba: np.ndarray) -> np.ndarray:
    """A premultiplied image over the wall behind the hand: (H, W, 3)."""
    return rgba[..., :3] + (1.0 - rgba[..., 3:]) * BEHIND
