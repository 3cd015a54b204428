"""The frames of a capture as a data set of PyTorch."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

import numpy as np
import torch
from torch.utils.data import Dataset

from hwp_bench.base.errors import of_type
from hwp_bench.capture import Capture
from hwp_bench.methods.contract import TrainingCapture


class CaptureDataset(Dataset[dict[str, Any]]):
    """The frames of a capture as tensors, read when they are asked for.

    An item is a dictionary of float32 tensors, which `torch.utils.data.DataLoader` batches:

    - `image` (H, W, 3) sRGB and `mask` (H, W), 1 = visible hand, both in [0, 1]
    - `K` (3, 3) px, pixel centres at +0.5, and `viewmat` (4, 4), world to camera, m, OpenCV axes
    - `hands`: by side `pose` (16, 3) rad, `betas` (10,), `transl` (3,) m, and whether the frame
      shows the hand, `valid`, a bool
    - `frame`, its index in the capture, an int

    Args:
        capture: an opened capture, or what a method is given.
        frames: indices of the frames, in order; None takes all of a `Capture` and the training
            frames of a `TrainingCapture`.
    """

    def __init__(
        self, capture: Capture | TrainingCapture, frames: Iterable[int] | None = None
    ) -> None:
        kinds = (Capture, TrainingCapture)
        self.capture = of_type(capture, kinds, "capture", "an opened capture")
        if frames is None:
            frames = capture.train if isinstance(capture, TrainingCapture) else range(len(capture))
        self.frames = [int(frame) for frame in frames]

    def __len__(self) -> int:
        return len(self.frames)

    def __getitem__(self, index: int) -> dict[str, Any]:
        capture, frame = self.capture, self.frames[index]
        camera = capture.camera(frame)
        arrays = {"image": capture.frame(frame) / 255.0, "mask": capture.mask(frame) / 255.0}
        item: dict[str, Any] = _tensors({**arrays, "K": camera.K, "viewmat": camera.viewmat})
        item |= {"frame": frame, "hands": {}}
        for side, hand in capture.hand_poses(frame).items():
            known = {"pose": hand.pose, "betas": hand.betas, "transl": hand.transl}
            valid = bool(capture.hands[side].valid[frame])
            item["hands"][side] = {**_tensors(known), "valid": valid}
        return item


def _tensors(arrays: dict[str, np.ndarray]) -> dict[str, torch.Tensor]:
    return {name: torch.from_numpy(array.astype(np.float32)) for name, array in arrays.items()}
