"""The frames of a clip as the fit of one hand sees them."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch

from hwp_bench.importers.shared.windows import CropWindows
from hwp_bench.importers.video.clip_model import ClipModel, posed_vertices


@dataclass(frozen=True, eq=False)
class HandPictures:
    """Images of a clip, and what is this hand's in them; S is the edge of the images.

    Attributes:
        images: (F, S, S, 3) uint8 RGB.
        masks: (F, S, S) uint8 coverage of the hand.
        usable: (F,) bool, frames that count.
        windows: where the images lie in the whole frame.
        hand_size: size of the hand in the whole frame, px.
        other: (F, S, S) uint8 coverage of another hand, or None.
    """

    images: np.ndarray
    masks: np.ndarray
    usable: np.ndarray
    windows: CropWindows
    hand_size: float
    other: np.ndarray | None = None

    @property
    def ratio(self) -> float:
        """Px of the images to one px of the whole frame."""
        return float(self.images.shape[1] / self.windows.side)

    @property
    def frames(self) -> list[int]:
        """The frames that count."""
        return [int(frame) for frame in np.flatnonzero(self.usable)]

    def placed(self, model: ClipModel) -> tuple[np.ndarray, np.ndarray]:
        """Place a model in the images: its vertices (F, V, 3) m, and (F, V, 2) px of them."""
        vertices = posed_vertices(model)
        with torch.no_grad():
            pixels = model.pixels(torch.as_tensor(vertices)).numpy()
        inside = (pixels - self.windows.corners[:, None]) * self.ratio
        return vertices, inside.astype(np.float32)
