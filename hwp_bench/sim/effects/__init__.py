"""Effects, registered by name: the four perturbations and the sensor.

They compose in a stated order: first the perturbations in the order of `ORDER` (pose, objects,
light, shutter), last the `SENSOR`, which is no perturbation: it has no episodes and no severity,
and every frame and its clean version pass it alike.
"""

from __future__ import annotations

import importlib
from functools import cache
from typing import TYPE_CHECKING

from hwp_bench.base.errors import BadInput

if TYPE_CHECKING:
    from hwp_bench.sim.effects.base import Effect

#: Order in which the perturbations act on a frame.
ORDER = ("complex_poses", "hand_object_interaction", "illumination", "motion_blur")
#: The effect that follows them in every frame.
SENSOR = "sensor"


@cache
def registered(kind: str) -> Effect:
    """Return the effect of a name; its module is imported on the first request.

    Raises:
        BadInput: there is none of that name.
    """
    known = (*ORDER, SENSOR)
    if kind not in known:
        raise BadInput(f"there is no effect {kind!r}", remedy=f"Known: {', '.join(known)}.")
    effect: Effect = importlib.import_module(f"hwp_bench.sim.effects.{kind}").EFFECT
    return effect
