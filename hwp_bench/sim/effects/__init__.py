"""Effects, registered by the name of the perturbation that they simulate.

They compose in the order of `ORDER`: pose first, then objects, light, shutter. The sensor,
which every frame passes, comes last and is no perturbation.
"""

from __future__ import annotations

import importlib
from functools import cache
from typing import TYPE_CHECKING

from hwp_bench.errors import BadInput

if TYPE_CHECKING:
    from hwp_bench.sim.effects.base import Effect

#: Order in which effects act on a frame.
ORDER = ("complex_poses", "hand_object_interaction", "illumination", "motion_blur")


@cache
def registered(kind: str) -> Effect:
    """Return the effect of a name; its module is imported on the first request.

    Raises:
        BadInput: there is none of that name.
    """
    if kind not in ORDER:
        raise BadInput(f"there is no effect {kind!r}", remedy=f"Known: {', '.join(ORDER)}.")
    effect: Effect = importlib.import_module(f"hwp_bench.sim.effects.{kind}").EFFECT
    return effect
