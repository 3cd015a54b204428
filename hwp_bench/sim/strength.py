"""From severity to an effect's strength: calibrated per scene where that was done."""

from __future__ import annotations

import json
from functools import cache
from importlib import resources
from typing import Any

import numpy as np

from hwp_bench.sim.effects import registered
from hwp_bench.sim.scene import EffectCall, Scene


@cache
def _calibrations() -> dict[str, Any]:
    """Stored calibrations by scene digest."""
    file = resources.files("hwp_bench.sim").joinpath("calibration.json")
    if not file.is_file():
        return {}
    stored: dict[str, Any] = json.loads(file.read_text("utf-8"))["scenes"]
    return stored


def strengths(scene: Scene, call: EffectCall) -> tuple[float, ...]:
    """Strengths of an effect at severity 1 to 5 in a scene.

    They come from the calibration that is stored under the scene's digest; a scene without one
    takes the effect's own.
    """
    stored = _calibrations().get(scene.digest, {}).get(call.kind)
    return tuple(stored["strengths"]) if stored else registered(call.kind).default_strengths


def strength_at(scene: Scene, call: EffectCall, level: float) -> float:
    """Strength at a level, interpolated between severities.

    Args:
        scene: the scene.
        call: the effect.
        level: from 0 (absent) to 5.
    """
    table = (0.0, *strengths(scene, call))
    return float(np.interp(level, np.arange(len(table)), table))
