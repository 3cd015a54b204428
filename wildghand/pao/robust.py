"""Robust weights from residuals, for frames without regions as large as a hand."""

from __future__ import annotations

import math
from dataclasses import dataclass, fields

import torch
from torch import Tensor

from hwp_bench.base.errors import ShapeMismatch, UsageError
from wildghand.pao.regions.frame_regions import Regions


@dataclass(frozen=True)
class RobustSettings:
    """How residuals become weights."""

    #: Share of the superpixel's mean in a pixel's residual; the rest is the mean of 3 x 3 pixels.
    region_share: float = 0.5
    #: Residual, in running medians, at which a pixel counts half.
    cutoff: float = 2.5
    #: How sharply weights fall beyond the cutoff.
    power: float = 4.0
    #: Share of the newest median in the running one.
    rate: float = 0.05
    #: Least median: half a level of 8 bits, below which differences are rounding.
    least_scale: float = 0.002

    def __post_init__(self) -> None:
        for item in fields(self):
            value = getattr(self, item.name)
            if not (math.isfinite(value) and value >= 0.0):
                raise UsageError(
                    f"is {value}", field=item.name, remedy="Use a finite number, 0 or more."
                )
        for name in ("region_share", "rate"):
            if getattr(self, name) > 1.0:
                raise UsageError(f"is {getattr(self, name)}", field=name, remedy="Use 0 to 1.")
        for name in ("cutoff", "power", "least_scale"):
            if getattr(self, name) == 0.0:
                raise UsageError("is 0", field=name, remedy="Use a number above 0.")


@torch.no_grad()
def blended_residual(
    error: Tensor, regions: Regions, hand: Tensor, settings: RobustSettings = RobustSettings()
) -> Tensor:
    """Residual of each hand pixel: its superpixel's mean blended with its neighbourhood's.

    The superpixel tells what belongs together, the 3 x 3 pixels what is sharper than it. Both
    means are over hand pixels only: what lies around the hand is not rendered.

    Args:
        error: (B, H, W) mean over channels of |rendering - input|.
        regions: superpixels of the frames.
        hand: (B, H, W) y_h: bool, or coverage in [0, 1], hand where above a half.
        settings: the blend.

    Returns:
        (B, H, W), 0 off the hand, infinite where the error is not finite; detached.

    Raises:
        ShapeMismatch: the arguments do not describe the same frames.
    """
    shapes = [tuple(tensor.shape) for tensor in (error, regions.index, hand)]
    if error.ndim != 3 or len(set(shapes)) > 1:
        raise ShapeMismatch(f"have the shapes {shapes}", field="error, regions, hand")
    on_hand = hand if hand.dtype == torch.bool else hand > 0.5
    finite = error.isfinite()
    counted = (on_hand & finite).to(error)
    known = torch.where(finite, error, torch.zeros_like(error)) * counted
    of_region = regions.sums(known) / regions.sums(counted).clamp(min=1.0)
    near = _box(torch.stack([known, counted], dim=1))
    of_pixel = near[:, 0] / near[:, 1].clamp(min=1.0)
    share = settings.region_share
    blended = (share * regions.spread(of_region) + (1.0 - share) * of_pixel) * counted
    return torch.where(on_hand & ~finite, torch.full_like(blended, math.inf), blended)


@torch.no_grad()
def running_median(
    previous: float | Tensor | None,
    residual: Tensor,
    hand: Tensor,
    settings: RobustSettings = RobustSettings(),
) -> float | Tensor:
    """Follow the median residual of hand pixels over the steps of a fit.

    Args:
        previous: what this gave at the step before; None at the first.
        residual: (B, H, W) as from `blended_residual`.
        hand: (B, H, W) y_h.
        settings: the rate.

    Returns:
        The new median, at least `least_scale`; `previous` where no hand pixel is finite. A number
        on the CPU, elsewhere a scalar on the device, float64, which nobody waits for.
    """
    on_hand = hand if hand.dtype == torch.bool else hand > 0.5
    if residual.device.type != "cpu":
        return _running_median_on_device(previous, residual, on_hand, settings)
    values = residual[on_hand]
    values = values[values.isfinite()]
    if not len(values):
        return settings.least_scale if previous is None else previous
    newest = float(values.median())
    if previous is not None:
        newest = float(previous) + settings.rate * (newest - float(previous))
    return max(newest, settings.least_scale)


def _running_median_on_device(
    previous: float | Tensor | None, residual: Tensor, on_hand: Tensor, settings: RobustSettings
) -> Tensor:
    """As above, without a shape that follows from the values."""
    counted = (on_hand & residual.isfinite()).flatten()
    ordered = torch.where(counted, residual.flatten(), math.inf).sort().values
    middle = (counted.sum() - 1).clamp(min=0) // 2
    found = ordered.gather(0, middle[None])[0].double()
    if previous is None:
        newest = torch.where(counted.any(), found, settings.least_scale)
    else:
        moved = previous + settings.rate * (found - previous)
        newest = torch.where(counted.any(), moved, previous)
    return newest.clamp(min=settings.least_scale)


@torch.no_grad()
def residual_weights(
    residual: Tensor, median: float | Tensor, settings: RobustSettings = RobustSettings()
) -> Tensor:
    """1 / (1 + (r / (2.5 median))^4).

    Args:
        residual: (B, H, W) not negative; infinite where nothing is known.
        median: as from `running_median`.
        settings: cutoff and power.

    Returns:
        (B, H, W) in [0, 1]: 1 without a residual (off the hand, for instance), 0 for infinity
        and NaN; detached.

    Source: an experiment on simulated captures; the form is that of a Cauchy weight with a
    fourth power, which leaves pixels below the median almost whole.
    """
    if isinstance(median, Tensor):
        scale: float | Tensor = settings.cutoff * median.clamp(min=settings.least_scale)
    else:
        scale = settings.cutoff * max(median, settings.least_scale)
    weights = 1.0 / (1.0 + (residual / scale).pow(settings.power))
    return torch.nan_to_num(weights, nan=0.0)


def _box(images: Tensor) -> Tensor:
    """Sum of 3 x 3 pixels, (B, C, H, W), zero beyond the border."""
    # Five times as fast on a CPU as torch's pooling.
    padded = torch.nn.functional.pad(images, (1, 1, 1, 1))
    rows = padded[..., 2:] + padded[..., 1:-1] + padded[..., :-2]
    return rows[..., 2:, :] + rows[..., 1:-1, :] + rows[..., :-2, :]
