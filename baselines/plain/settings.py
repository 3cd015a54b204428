"""Settings of the plain baseline, checked when read."""

from __future__ import annotations

import difflib
import math
from collections.abc import Mapping
from dataclasses import dataclass, fields
from typing import Any

from hwp_bench.errors import BadMethod
from wildghand.shading import MAX_DEGREE

_WHERE = "baselines/plain"


@dataclass(frozen=True)
class PlainSettings:
    """How the plain baseline fits; the defaults are those of the preset `default`."""

    #: Gaussians on each hand.
    gaussians: int = 12_000
    #: Optimiser steps unless the budget says otherwise.
    steps: int = 2_000
    #: Frames in each step.
    batch: int = 1
    #: Degree of the spherical harmonics of the light, 0 (no shading) to 3.
    shading_degree: int = 2
    #: Share of D-SSIM in the loss; the rest is L1.
    dssim_weight: float = 0.2
    #: Weight of a pixel outside the visible-hand mask, beside 1 inside.
    outside_weight: float = 0.03
    #: Opacity of every Gaussian at the start.
    initial_opacity: float = 0.9
    #: Adam step of the offsets, m.
    offset_rate: float = 2e-4
    #: Adam step of the log scales.
    scale_rate: float = 0.01
    #: Adam step of the quaternions.
    quat_rate: float = 0.01
    #: Adam step of the logit opacities.
    opacity_rate: float = 0.05
    #: Adam step of the logit colours.
    color_rate: float = 0.03
    #: Adam step of the light.
    light_rate: float = 0.01
    #: The steps' size at the end of the budget, as a share of that at its start; in between it
    #: falls geometrically.
    final_rate: float = 0.05
    #: `auto` (CUDA where both a GPU and gsplat are there), `cpu` or `cuda`.
    device: str = "auto"


# Lowest and highest value of the settings; every other number must not be negative.
_RANGES: Mapping[str, tuple[float, float]] = {
    "gaussians": (1, 1_000_000),
    "steps": (1, 10_000_000),
    "batch": (1, 64),
    "shading_degree": (0, MAX_DEGREE),
    "dssim_weight": (0.0, 1.0),
    "outside_weight": (0.0, 1.0),
    "initial_opacity": (0.01, 0.99),
    "final_rate": (1e-6, 1.0),
}
_DEVICES = ("auto", "cpu", "cuda")


def read_settings(values: Mapping[str, Any]) -> PlainSettings:
    """Check a preset's table with its overrides.

    Args:
        values: any of the fields of `PlainSettings`.

    Raises:
        BadMethod: an unknown name (the message says which one is close), a wrong type, or a
            value outside its range.
    """
    types = {item.name: item.type for item in fields(PlainSettings)}
    checked: dict[str, Any] = {}
    for name, value in values.items():
        if name not in types:
            close = difflib.get_close_matches(str(name), types, n=1)
            raise BadMethod(
                "is no setting of this method",
                where=_WHERE,
                field=str(name)[:100],
                remedy=f"Did you mean {close[0]!r}?" if close else f"Known: {sorted(types)}.",
            )
        checked[name] = _checked(name, value, str(types[name]))
    return PlainSettings(**checked)


def _checked(name: str, value: Any, kind: str) -> Any:
    if kind == "str":
        if value not in _DEVICES:
            raise _bad(name, value, f"Use one of {', '.join(_DEVICES)}.")
        return value
    numbers = (int,) if kind == "int" else (int, float)
    if isinstance(value, bool) or not isinstance(value, numbers):
        raise _bad(name, value, "Use a whole number." if kind == "int" else "Use a number.")
    low, high = _RANGES.get(name, (0.0, math.inf))
    if not low <= value <= high or not math.isfinite(value):
        raise _bad(name, value, f"Use {low:g} to {high:g}.")
    return value if kind == "int" else float(value)


def _bad(name: str, value: Any, remedy: str) -> BadMethod:
    return BadMethod(f"is {value!r}"[:200], where=_WHERE, field=name, remedy=remedy)
