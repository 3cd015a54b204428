"""The training frames, held in memory as 8-bit images."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch

from hwp_bench.base.errors import BadInput
from hwp_bench.methods.contract import TrainingCapture


@dataclass(frozen=True, eq=False)
class TrainingFrames:
    """R training frames that can be fitted."""

    #: (R,) which frames of the capture they are.
    indices: np.ndarray
    #: (R, H, W, 3) uint8 sRGB.
    images: torch.Tensor
    #: (R, H, W) uint8, 255 = visible hand.
    masks: torch.Tensor

    def __len__(self) -> int:
        return len(self.indices)

    def targets(
        self, rows: torch.Tensor, outside_weight: float, device: torch.device
    ) -> tuple[torch.Tensor, torch.Tensor]:
        """What the renderings of a batch are compared with.

        Args:
            rows: (B,) int64.
            outside_weight: weight of a pixel that the mask leaves out.
            device: where the result lives.

        Returns:
            (B, H, W, 3) float32 image over black outside the mask, and (B, H, W) pixel weights.
        """
        masks = self.masks[rows].to(device).float() / 255.0
        images = self.images[rows].to(device).float() / 255.0
        return images * masks[..., None], outside_weight + (1.0 - outside_weight) * masks

    def mean_color(self) -> torch.Tensor:
        """(3,) mean sRGB colour of the visible hand, in [0, 1]."""
        total = torch.zeros(3, dtype=torch.float64)
        weight = torch.zeros((), dtype=torch.float64)
        for image, mask in zip(self.images, self.masks, strict=True):
            inside = image[mask > 127].double()
            total += inside.sum(dim=0)
            weight += len(inside)
        return (total / weight / 255.0).float()


def load_frames(training: TrainingCapture) -> TrainingFrames:
    """Read the training frames that show a hand and whose parameters are valid.

    Left out are frames in which the estimator of any of the capture's hands failed (the mask
    then covers a hand that cannot be placed) and frames whose mask is empty.

    Raises:
        BadImage: an image is missing or damaged.
        BadInput: no frame is left.
    """
    valid = np.all([hand.valid for hand in training.hands.values()], axis=0)
    kept, images, masks = [], [], []
    for frame in training.train.tolist():
        if not valid[frame]:
            continue
        mask = training.mask(frame)
        if (mask > 127).any():
            kept.append(frame)
            images.append(training.frame(frame))
            masks.append(mask)
    if not kept:
        raise BadInput(
            f"none of {len(training.train)} training frames has valid hand parameters and a mask",
            where=training.root,
            remedy="Check the capture with `hwp-bench data show`.",
        )
    return TrainingFrames(
        indices=np.array(kept),
        images=torch.from_numpy(np.stack(images)),
        masks=torch.from_numpy(np.stack(masks)),
    )
