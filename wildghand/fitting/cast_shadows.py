"""The shadows in a clip, found before the first step of a fit."""

from __future__ import annotations

from collections.abc import Callable

from torch import Tensor

from wildghand.fitting.shadow_samples import shadow_samples
from wildghand.fitting.weighting import Weighting
from wildghand.gaussians.training import TrainingClip, TrainingFrames
from wildghand.light import ShadowSettings, ShadowTable, find_light
from wildghand.model.model import WildGHandModel

#: From rows, (B,) int64 on the CPU, to (B, N) factors on the Gaussians' colours by side.
Dark = Callable[[Tensor], dict[str, Tensor]]


def cast_shadows(
    model: WildGHandModel,
    clip: TrainingClip,
    frames: TrainingFrames,
    weighting: Weighting,
    settings: ShadowSettings,
    seed: int,
) -> None:
    """Find the light that casts shadows in a clip, and let a model keep it.

    Args:
        model: it casts no shadow where the settings say so, or too little of the hand is seen.
        clip: hands and cameras of the frames.
        frames: that are fitted.
        weighting: how much each pixel says of the hand.
        settings: how.
        seed: of the choice of places.
    """
    if not settings.enabled:
        return
    samples = shadow_samples(model.rigs, clip, frames, weighting, settings, seed)
    light = find_light(samples, settings)
    if light is not None:
        model.keep(light)


def shadows_in(model: WildGHandModel, clip: TrainingClip) -> Dark:
    """The shadows that a model casts in the frames of a clip; none where it casts none."""
    if model.shadows is None:
        return lambda rows: {}
    return ShadowTable(model.shadows, clip)
