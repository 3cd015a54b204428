"""The end of a fit: the light, and weight masks to look at."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from hwp_bench.base.arrays import evenly
from wildghand.fitting.light_samples import CHUNK, light_samples
from wildghand.gaussians.training import TrainingClip
from wildghand.light import KnownLight, LightSettings, fit_light
from wildghand.model.model import WildGHandModel

#: Most weight masks of an avatar, spread evenly over the clip.
MAX_MASKS = 100
#: Largest share of a budget that is kept for the end of a fit.
MOST_OF_BUDGET = 0.5


@dataclass(frozen=True, eq=False)
class LightFit:
    """The fit of the light of a clip to what a model says of it."""

    #: What is read; it goes on changing until the light is learnt.
    model: WildGHandModel
    #: Hands and cameras of the R frames.
    clip: TrainingClip
    #: (R,) how much each frame counts.
    frame_weights: Tensor
    #: How.
    settings: LightSettings
    #: Of the choice of samples.
    seed: int

    def learn(self, frames: int | None = None) -> KnownLight | None:
        """Fit the light; None where it is switched off, or where too little of it is seen.

        Args:
            frames: the first frames alone, with their part of the samples; None: all.
        """
        if not self.settings.enabled:
            return None
        count = len(self.frame_weights)
        read = count if frames is None else frames
        samples = light_samples(
            self.model,
            self.clip,
            self.frame_weights[:read],
            self.settings.samples * read // count,
            self.seed,
        )
        return fit_light(samples, self.settings)

    def seconds(self) -> float:
        """Return about how long `learn` takes.

        The light of a few frames is fitted to see it. Nothing of the model changes.
        """
        if not self.settings.enabled:
            return 0.0
        self._timed(1)  # The first time takes longer than others.
        one, many = self._timed(1), min(len(self.frame_weights), CHUNK)
        each = max(0.0, self._timed(many) - one) / max(1, many - 1)
        return one + each * (len(self.frame_weights) - 1)

    def _timed(self, frames: int) -> float:
        entered = time.perf_counter()
        self.learn(frames)
        return time.perf_counter() - entered


@torch.no_grad()
def weight_masks(
    frames: Sequence[int], weigh: Callable[[Tensor], Tensor], *, unbounded: bool
) -> dict[int, np.ndarray]:
    """Return the weights of pixels in training frames as images, 255 = full weight.

    Args:
        frames: the R frames of the capture.
        weigh: takes rows, (B,) int64 below R, and returns (B, H, W) weights.
        unbounded: the paper's equations have no bound: 255 is the largest weight of a frame.

    Returns:
        (H, W) uint8 by frame, for `MAX_MASKS` frames at most.
    """
    masks = {}
    for row in evenly(len(frames), MAX_MASKS).tolist():
        weights = weigh(torch.tensor([row]))[0]
        largest = weights.max().clamp(min=1e-12 if unbounded else 1.0)
        masks[frames[row]] = (255.0 * weights / largest).byte().cpu().numpy()
    return masks
