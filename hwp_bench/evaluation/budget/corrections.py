"""Corrections of a predicted frame that only its truth can tell: oracles at test time.

Each takes away one kind of error as far as a few numbers can: light as a gain of linear light,
place as a motion of the image, pose as a motion of the posed surface. What a correction gains is
what that kind of error costs. The parameters are found by Gauss-Newton steps on the squared error
in sRGB, which PSNR counts.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace
from types import MappingProxyType

import numpy as np

from hwp_bench.evaluation.budget.light import gain, gain_map, light
from hwp_bench.evaluation.budget.motion import motion, pose
from hwp_bench.evaluation.budget.pair import Pair


def motion_and_light(pair: Pair) -> np.ndarray:
    """A motion, and then another light."""
    return light(replace(pair, prediction=motion(pair)))


#: The corrections by name, with what each of them takes away.
CORRECTIONS: Mapping[str, tuple[Callable[[Pair], np.ndarray], str]] = MappingProxyType(
    {
        "gain": (gain, "one gain a channel and frame: exposure, white balance"),
        "light": (light, "a gain by the normal, degree 2: the light of the frame"),
        "motion": (motion, "an affine motion of the image: place, turn and size of the hand"),
        "pose": (pose, "every joint's rotation and the translation: the pose of the frame"),
        "motion+light": (motion_and_light, "an affine motion, then another light"),
        "gain map": (gain_map, "a gain on a 12 x 12 grid: everything smooth"),
    }
)
