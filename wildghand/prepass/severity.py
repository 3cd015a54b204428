"""A rough severity of each perturbation, for captures that do not know their own."""

from __future__ import annotations

from collections.abc import Mapping
from types import MappingProxyType

import numpy as np

from wildghand.prepass.judgement import Judgement

#: The cue that tells each perturbation, and how many of its deviations make one level: about
#: what they are on simulated captures, where the levels are known (docs/prepass.md).
CUES: Mapping[str, tuple[str, float]] = MappingProxyType(
    {
        "hand_object_interaction": ("hidden_deviation", 1.0),
        "complex_poses": ("misplacement_deviation", 5.0),
        "illumination": ("gain_deviation", 2.5),
        "motion_blur": ("blur_deviation", 0.7),
    }
)
#: From this probability on a frame is taken as unperturbed.
CLEAN_FROM = 0.5


def estimated_severity(judgement: Judgement) -> dict[str, np.ndarray]:
    """Guess how strongly each perturbation acts in each frame.

    The cues are not blind to each other's perturbations: blur also moves outlines, and an
    object also hides texture. What is certain is `judgement.clean`; the split is a guess.

    Args:
        judgement: of R frames.

    Returns:
        (R,) int, 0-5, for each perturbation of the taxonomy; 0 wherever the frame is judged
        clean or cannot be used.
    """
    acting = (judgement.clean < CLEAN_FROM) & judgement.usable
    levels = {}
    for kind, (cue, deviations) in CUES.items():
        level = np.clip(np.rint(getattr(judgement, cue) / deviations), 0, 5)
        levels[kind] = np.where(acting, level, 0).astype(np.int64)
    return levels
