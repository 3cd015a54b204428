"""What follows the last step of a fit: the light, and weight masks to look at."""

from __future__ import annotations

import time
from typing import TYPE_CHECKING

import numpy as np
import torch

from wildghand.fitting.light_samples import CHUNK, light_samples
from wildghand.light import fit_light

if TYPE_CHECKING:
    from wildghand.fitting.fit import Fit

#: Most weight masks of an avatar, spread evenly over the clip.
MAX_MASKS = 100
# Largest share of a budget that is kept for the light.
_MOST = 0.5


def learn_light(fit: Fit) -> None:
    """Fit the light of the clip to what the model says of it, where the settings do."""
    settings = fit.settings.light
    if not settings.enabled:
        return
    weights = fit.weighting.frame_weights
    samples = light_samples(fit.model, fit.clip, weights, settings.samples, fit.seed)
    light = fit_light(samples, settings)
    if light is not None:
        fit.model.keep(light)


def seconds_for_steps(fit: Fit, seconds: float) -> float:
    """Return the part of a budget that is for steps: all but what the light is going to take.

    The light of a few frames is read to see how long it takes. Nothing of the fit changes.

    Args:
        fit: that has not ended.
        seconds: of the whole fit.
    """
    settings = fit.settings.light
    if not settings.enabled:
        return seconds
    weights = fit.weighting.frame_weights

    def read(frames: int) -> float:
        # As many samples of each frame as the whole clip is going to give.
        count = settings.samples * frames // len(weights)
        entered = time.perf_counter()
        fit_light(light_samples(fit.model, fit.clip, weights[:frames], count, fit.seed), settings)
        return time.perf_counter() - entered

    read(1)  # The first time takes longer than others.
    few = read(1)
    many = min(len(weights), CHUNK)
    each = max(0.0, read(many) - few) / max(1, many - 1)
    return seconds - min(few + each * (len(weights) - 1), _MOST * seconds)


@torch.no_grad()
def weight_masks(fit: Fit) -> dict[int, np.ndarray]:
    """Return the weights of pixels in training frames as images, 255 = full weight.

    The paper's equations have no bound: with them 255 is the largest weight of the frame.
    """
    if not fit.settings.pao.enabled:
        return {}
    frames = fit.frames.indices.tolist()
    unbounded = fit.settings.pao.variant == "printed"
    masks = {}
    for row in np.unique(np.linspace(0, len(frames) - 1, min(MAX_MASKS, len(frames))).round()):
        rows = torch.tensor([int(row)])
        weights = fit.weighting(rows, fit.draw(rows)).weights[0]
        largest = weights.max().clamp(min=1e-12 if unbounded else 1.0)
        masks[frames[int(row)]] = (255.0 * weights / largest).byte().cpu().numpy()
    return masks
