"""The running median of errors: what is an ordinary error at this point of a fit."""

from __future__ import annotations

import math

import torch
from torch import Tensor

#: Share of the newest median in the running one.
RATE = 0.05
#: Least median: half a level of 8 bits, below which differences are rounding.
LEAST = 0.002


@torch.no_grad()
def running_median(
    previous: float | Tensor | None, errors: Tensor, counted: Tensor
) -> float | Tensor:
    """Follow the median of errors over the steps of a fit.

    Args:
        previous: what this gave at the step before; None at the first.
        errors: (...) not negative.
        counted: as `errors`, bool: those that count; the others, and those that are not finite,
            do not.

    Returns:
        The new median, at least `LEAST`; `previous` where nothing counts. A number on the CPU,
        elsewhere a scalar on the device, float64, which nobody waits for.
    """
    counted = counted & errors.isfinite()
    if errors.device.type != "cpu":
        return _on_device(previous, errors, counted)
    values = errors[counted]
    if not len(values):
        return LEAST if previous is None else previous
    newest = float(values.median())
    if previous is not None:
        newest = float(previous) + RATE * (newest - float(previous))
    return max(newest, LEAST)


def _on_device(previous: float | Tensor | None, errors: Tensor, counted: Tensor) -> Tensor:
    """As above, without a shape that follows from the values."""
    ordered = torch.where(counted, errors, math.inf).flatten().sort().values
    middle = (counted.sum() - 1).clamp(min=0) // 2
    found = ordered.gather(0, middle[None])[0].double()
    if previous is None:
        newest = torch.where(counted.any(), found, LEAST)
    else:
        newest = torch.where(counted.any(), previous + RATE * (found - previous), previous)
    return newest.clamp(min=LEAST)
