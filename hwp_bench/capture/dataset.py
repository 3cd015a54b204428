"""The frames of a capture as a data set of PyTorch."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Any, Protocol

import numpy as np
import torch
from torch.utils.data import Dataset

from hwp_bench.base.errors import UsageError, whole_number
from hwp_bench.hands.skeleton import Camera, HandParameters


class Frames(Protocol):
    """What `CaptureDataset` reads: a `Capture`, or the `TrainingCapture` of a method."""

    hands: dict[str, HandParameters]

    def frame(self, frame: int) -> np.ndarray:
        """Read a frame: (H, W, 3) uint8 sRGB."""
        ...

    def mask(self, frame: int) -> np.ndarray:
        """Read its mask: (H, W) uint8, 255 = hand."""
        ...

    def camera(self, frame: int) -> Camera:
        """Return its camera."""
        ...


class CaptureDataset(Dataset[dict[str, Any]]):
    """The frames of a capture as tensors, read when they are asked for.

    An item is a dictionary, which `torch.utils.data.DataLoader` joins to batches:

    - `frame`: index of the frame in the capture, int
    - `image`: (H, W, 3) float32 in [0, 1], sRGB
    - `mask`: (H, W) float32 in [0, 1], 1 = visible hand
    - `K`: (3, 3) float32, px; pixel centres lie at +0.5
    - `viewmat`: (4, 4) float32, world to camera, m, OpenCV axes
    - `hands`: by side `pose` (16, 3) rad, `betas` (10,) and `transl` (3,) m, float32, and `valid`,
      bool: whether the frame shows the hand

    Args:
        capture: a `Capture`, or the `TrainingCapture` that a method is given.
        frames: indices of the frames, in order; those of `capture.train` where there are such (a
            `TrainingCapture`), else all, if None.
    """

    def __init__(self, capture: Frames, frames: Iterable[int] | None = None) -> None:
        if not hasattr(capture, "hands") or not hasattr(capture, "mask"):
            raise UsageError(
                f"is of type {type(capture).__name__}",
                field="capture",
                remedy="Give an opened capture: hwp_bench.open_capture(folder).",
            )
        count = next(iter(capture.hands.values())).frame_count
        chosen = getattr(capture, "train", range(count)) if frames is None else frames
        self.capture = capture
        self.frames = [whole_number(frame, "frames") for frame in chosen]
        for frame in self.frames:
            if not 0 <= frame < count:
                raise UsageError(f"{frame} is not from 0 to {count - 1}", field="frames")

    def __len__(self) -> int:
        return len(self.frames)

    def __getitem__(self, index: int) -> dict[str, Any]:
        frame = self.frames[index]
        camera = self.capture.camera(frame)
        return {
            "frame": frame,
            "image": _tensor(self.capture.frame(frame)) / 255.0,
            "mask": _tensor(self.capture.mask(frame)) / 255.0,
            "K": _tensor(camera.K),
            "viewmat": _tensor(camera.viewmat),
            "hands": {side: _hand(hand, frame) for side, hand in self.capture.hands.items()},
        }


def _hand(hand: HandParameters, frame: int) -> Mapping[str, torch.Tensor | bool]:
    arrays = {"pose": hand.pose[frame], "betas": hand.betas, "transl": hand.transl[frame]}
    tensors = {name: _tensor(array) for name, array in arrays.items()}
    return {**tensors, "valid": bool(hand.valid[frame])}


def _tensor(array: np.ndarray) -> torch.Tensor:
    return torch.from_numpy(array.astype(np.float32))
