"""From severity to an effect's strength: calibrated per scene where that was done."""

from __future__ import annotations

import numpy as np

from hwp_bench.sim.effects import registered
from hwp_bench.sim.scene import EffectCall


def strengths(call: EffectCall) -> tuple[float, ...]:
    """Strengths of an effect at severity 1 to 5.

    The scene's own where it was calibrated (`hwp-bench sim calibrate`), else the effect's.
    """
    return call.strengths or registered(call.kind).default_strengths


def strength_at(call: EffectCall, level: float) -> float:
    """Strength at a level, interpolated between severities.

    Args:
        call: the effect.
        level: from 0 (absent) to 5.
    """
    table = (0.0, *strengths(call))
    return float(np.interp(level, np.arange(len(table)), table))
