"""Perturbation-aware optimization: how much each pixel of a frame counts.

Weights follow the errors of regions. An error is counted in what is ordinary: the running median of
all regions, or the ordinary error of the region's places on the hand.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from types import MappingProxyType
from typing import ClassVar, Literal, NamedTuple

import torch
from torch import Tensor, nn

from hwp_bench.base.errors import ShapeMismatch
from hwp_bench.methods.settings import check_source
from wildghand.gaussians.losses import full_precision
from wildghand.gaussians.training import upload
from wildghand.pao.regions import ClipRegions, Regions

#: Share of the newest median in the running one.
RATE = 0.05
#: Least median: half a level of 8 bits, below which differences are rounding.
LEAST = 0.002


@torch.no_grad()
def running_median(
    previous: float | Tensor | None, errors: Tensor, counted: Tensor
) -> float | Tensor:
    """Follow the median of errors over the steps of a fit."""
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
    if not errors.numel():  # No region in these frames.
        kept = LEAST if previous is None else previous
        return torch.as_tensor(kept, dtype=torch.float64, device=errors.device)
    ordered = torch.where(counted, errors, math.inf).flatten().sort().values
    middle = (counted.sum() - 1).clamp(min=0) // 2
    found = ordered.gather(0, middle[None])[0].double()
    if previous is None:
        newest = torch.where(counted.any(), found, LEAST)
    else:
        newest = torch.where(counted.any(), previous + RATE * (found - previous), previous)
    return newest.clamp(min=LEAST)


#: Share of the newest error of a place in its ordinary one, in a frame that is surely clean.
PLACE_RATE = 0.1
#: An error counts at most this often the ordinary one: something in front changes it slowly.
MOST = 3.0


class PlaceErrors:
    """The ordinary error of each place of the hand at this point of a fit.

    A hand that is not the template, a nail, a ring or poses that are always a little wrong leave
    errors at the same places in every frame. Regions are compared with these, not with the mean
    hand, and never with less than the running median of all regions.

    Args:
        places: the place of each pixel of the R frames; frames share their numbers.
        trust: (R,) in [0, 1], how much a frame may teach what is ordinary: the probability that it
            is clean.
        count: C, places of the clip; they are numbered from 0.

    Attributes:
        ordinary: (C,) mean over channels of |rendering - input|; 0 where nothing is known.
    """

    def __init__(self, places: ClipRegions, trust: Tensor, count: int) -> None:
        self._places, self._trust = places, trust
        self.ordinary = torch.zeros(count, device=trust.device)

    def expected(self, rows: Tensor, median: float | Tensor) -> Tensor:
        """The ordinary error at every pixel, at least the running median.

        Args:
            rows: (B,) int64 on the CPU, which of the frames.

        Returns:
            (B, H, W), positive.
        """
        places = self._places(rows)
        floor = torch.clamp(self.ordinary, min=LEAST)
        floor = torch.maximum(floor, torch.as_tensor(median, device=floor.device).to(floor))
        # The regions of a batch may end before the last place of the clip.
        return places.spread(floor[: places.count].expand(len(rows), -1).contiguous())

    @torch.no_grad()
    def watch(self, rows: Tensor, error: Tensor, hand: Tensor, median: float | Tensor) -> None:
        """Learn from B frames.

        Args:
            rows: (B,) int64 on the CPU.
            error: (B, H, W) mean over channels of |rendering - input|; finite where `hand` is.
            hand: (B, H, W) bool.
            median: of the regions' errors; the first error of a place counts at most `MOST` times.
        """
        places, ones = self._places(rows), hand.to(error)
        pixels = places.sums(ones)
        errors = places.sums(torch.where(hand, error, torch.zeros_like(error)))
        errors = errors / pixels.clamp(min=1.0)
        unit = torch.as_tensor(median, device=error.device).to(error)
        trusts = self._trust[upload(rows, self._trust.device)]
        ordinary = self.ordinary[: places.count]
        for mine, seen, trust in zip(errors, pixels > 0.0, trusts, strict=True):
            known = torch.where(ordinary > 0.0, ordinary, unit)
            bounded = torch.minimum(mine, MOST * torch.maximum(known, unit))
            moved = known + PLACE_RATE * trust * (bounded - known)
            ordinary = torch.where(seen & mine.isfinite(), moved, ordinary)
        self.ordinary = torch.cat([ordinary, self.ordinary[places.count :]])


#: T_b at the start, for one hand and for two, as the authors have it: where the error of the
#: background is above it, the background has weight 0.
BACKGROUND_THRESHOLDS = (3.0, 10.0)
#: Coverage from which the authors' code takes a pixel for drawn.
DRAWN_FROM = 0.95
#: Colour channels: the paper's background error is their sum, its region error their mean.
_CHANNELS = 3.0


class PaoConstants(NamedTuple):
    """Factors, and thresholds at the start."""

    #: Of every region's weight.
    alpha: float
    #: How strongly the temporal weight of a frame lowers its weight.
    beta: float
    #: T_E: regions with a larger error have weight 0.
    error_threshold: float
    #: T_mu: regions with a smaller share of hand have weight 0.
    share_threshold: float


#: The paper prints thresholds; alpha and beta are the authors' code's.
_PUBLISHED = PaoConstants(100.0, 1000.0, 1.0, 0.3)
#: By variant. `scaled` counts errors in ordinary ones. With beta = 1000 an omega of 0.005, which is
#: noise, would cost a frame five sixths of its weight.
CONSTANTS: Mapping[str, PaoConstants] = MappingProxyType(
    {
        "scaled": PaoConstants(1.0, 100.0, 3.0, 0.0),
        "printed": _PUBLISHED,
        # Their temporal factor is 1 for every omega: it is rounded to an integer.
        "released": _PUBLISHED._replace(beta=0.0),
    }
)


@dataclass(frozen=True)
class PaoSettings:
    """Perturbation-aware weights."""

    #: Component: weigh frames and regions. Without it a pixel counts as the estimated mask says.
    enabled: bool = True
    #: `scaled`: the paper's equations with weights up to 1 on the hand, the constant
    #: `terms.outside_weight` outside, and the temporal factor on what the canonical hand learns.
    #: `printed`: as printed. `released`: as in the authors' code. `binary`: the hand's mask alone
    #: (the paper's table).
    variant: Literal["scaled", "printed", "released", "binary"] = "scaled"
    #: The regions y_u: `superpixels`, or `sam:PATH`, the masks of a Segment Anything checkpoint.
    regions: str = "superpixels"
    #: The hand y_h: the `estimated` mask of the capture; `graph-cut`, prompted by the projected
    #: hand; or `sam:PATH`, Segment Anything at the projected hand root, as in the paper.
    hand: str = "estimated"

    #: How far a mismatch that every frame of the clip shares lifts the weights of regions towards
    #: 1 (`wildghand.prepass.FrameAssessment.shared_mismatch`), in `scaled`.
    mismatch: ClassVar[float] = 1.0
    #: Lift the weights of a frame's regions towards 1 by the probability that the frame is clean,
    #: as the pre-pass judges, in `scaled`: a large error there is a fault of the fit.
    spare_clean: ClassVar[bool] = True

    @property
    def by_regions(self) -> bool:
        """Whether frames are cut into regions."""
        return self.enabled and self.variant != "binary"

    def __post_init__(self) -> None:
        check_source(self.regions, "regions", ("superpixels",), ("sam",))
        check_source(self.hand, "hand", ("estimated", "graph-cut"), ("sam",))


@dataclass(frozen=True, eq=False)
class Weights:
    """Weights of the pixels of B frames, and what they are made of."""

    #: (B, H, W) W, not negative.
    weights: Tensor
    #: (B, U) lambda_u.
    lambdas: Tensor
    #: (B, U) E_u, as compared with T_E; 0 where a region has no hand.
    errors: Tensor
    #: (B, U) the regions' mean errors before they were counted in anything.
    mean_errors: Tensor
    #: (B, U) mu_u in [0, 1].
    shares: Tensor


class PerturbationAwareWeights(nn.Module):
    """lambda_u and W from the error of the current rendering, with learnable thresholds.

    Args:
        variant: which `CONSTANTS`, and which of the two functions.
        hands: one or two; the background threshold differs.
        share_of: what mu is a share of. "hand" is the paper's formula, |region and hand| / |hand|,
            which needs regions as large as a hand; "region" its sentence, |region and hand| /
            |region|, which superpixels can reach too. "auto" takes the formula where regions may
            overlap (Segment Anything's) and the sentence for a partition into superpixels.

    The thresholds need their own learning rate (the paper's is 1e-6). In `forward` gradients reach
    nothing but them: a gradient through the errors would reward errors that lower a weight, and a
    gradient through omega a larger omega.

    Source: WildGHand, section "Perturbation-aware Optimization", equations of lambda_u and W,
    read so that they are defined everywhere; `docs/dpd_pao.md` lists the differences.
    """

    def __init__(
        self,
        variant: str = "scaled",
        hands: int = 1,
        *,
        share_of: Literal["auto", "hand", "region"] = "auto",
    ) -> None:
        super().__init__()
        self.variant, self.constants = variant, CONSTANTS[variant]
        self._share_of = share_of
        self.T_E = nn.Parameter(torch.tensor(self.constants.error_threshold))
        self.T_mu = nn.Parameter(torch.tensor(self.constants.share_threshold))
        self.T_b = nn.Parameter(torch.tensor(BACKGROUND_THRESHOLDS[hands > 1]))

    def forward(
        self,
        error: Tensor,
        regions: Regions,
        hand: Tensor,
        omega: Tensor,
        expected: Tensor | None = None,
    ) -> Weights:
        """Weigh B frames, as printed or `scaled`.

        Args:
            error: (B, H, W) mean over channels of |rendering - input|; a pixel that is not
                finite gets weight 0 and counts in no region. Half precision, here and in omega
                and `expected`, is computed in float32: float16 overflows in sums over a region.
            regions: y_u of the frames.
            hand: (B, H, W) y_h: bool, or coverage in [0, 1], hand where above a half.
            omega: (B,) temporal weights.
            expected: (B, H, W) ordinary error at each pixel, positive, in which `scaled` counts;
                None: the median of the regions' errors is.

        Raises:
            ShapeMismatch: the arguments do not describe the same frames.
        """
        _check_shapes(error, regions, hand, omega)
        error, omega = full_precision(error.detach()), full_precision(omega)
        on_hand = hand if hand.dtype == torch.bool else hand > 0.5
        # Off the CPU the question would wait for the device.
        sound = error.device.type == "cpu" and bool(error.sum().isfinite())
        finite = None if sound else error.isfinite()
        counted = on_hand
        if finite is not None:
            error = torch.where(finite, error, torch.zeros_like(error))
            counted = on_hand & finite
        means, pixels = _region_means(error, regions, counted)
        shares, present = self._shares(pixels, regions, on_hand), pixels > 0.0
        errors, scaled = means, self.variant == "scaled"
        if scaled and expected is None:
            errors = means / running_median(None, means, present)
        elif scaled and expected is not None:
            ordinary, _ = _region_means(full_precision(expected), regions, counted)
            errors = torch.where(
                present, means / ordinary.clamp(min=LEAST), torch.zeros_like(means)
            )
        lambdas = self._lambdas(errors, shares)
        if scaled:
            most = self.T_E.detach() * (1.0 - self.T_mu.detach())
            lambdas = lambdas / most.clamp(min=1e-6)
            weights = regions.spread(lambdas) * hand
        else:
            lambdas = lambdas * self.temporal_factor(omega.detach())[:, None]
            background = torch.relu(self.T_b - _CHANNELS * error)
            weights = regions.spread(lambdas) + ~on_hand * background
        if finite is not None:
            weights = weights * finite
        return Weights(weights, lambdas, errors, means, shares)

    def released(
        self,
        residual: Tensor,
        regions: Regions,
        visible: Tensor,
        silhouette: Tensor,
        coverage: Tensor,
    ) -> Weights:
        """Weigh B frames as the authors' code does. Gradients reach the rendering, as there.

        Args:
            residual: (B, H, W, 3) |rendering - input|, of the whole input.
            regions: y_u of the frames.
            visible: (B, H, W) bool, y_h.
            silhouette: (B, H, W) bool, where the posed mesh is, whatever covers it.
            coverage: (B, H, W) of the rendering.

        Source: what the authors' `train_single.py` and `train_multi.py` do, in code of our own.
        """
        low, high = residual.amin(), residual.amax()
        span = high - low
        stretched = (residual - low) / torch.where(span > 0.0, span, torch.ones_like(span))
        error = stretched.mean(dim=-1)
        errors, pixels = _region_means(error, regions, silhouette)
        shares = self._shares(pixels, regions, silhouette)
        lambdas = self._lambdas(errors, shares)
        # Skin that is drawn behind something counts nothing; what is drawn nowhere is background.
        seen = visible.sum(dim=(1, 2)).clamp(min=1)
        background = torch.relu(self.T_b - error.sum(dim=(1, 2)) / seen)[:, None, None]
        weights = regions.spread(lambdas) * visible
        weights = weights + (coverage.detach() < DRAWN_FROM) * background
        return Weights(weights, lambdas, errors, errors, shares)

    def temporal_factor(self, omega: Tensor) -> Tensor:
        """1 / (1 + beta |omega|), in (0, 1]; the paper's has no absolute value.

        Args:
            omega: (B,) temporal weights.
        """
        return 1.0 / (1.0 + self.constants.beta * omega.abs())

    def _lambdas(self, errors: Tensor, shares: Tensor) -> Tensor:
        """alpha kappa(T_E - E_u) kappa(mu_u - T_mu), (B, U)."""
        gates = torch.relu(self.T_E - errors) * torch.relu(shares - self.T_mu)
        # A region without hand has no error; it must stay out even if T_mu learns to be < 0.
        return self.constants.alpha * gates * (shares > 0.0)

    def _shares(self, pixels: Tensor, regions: Regions, hand: Tensor) -> Tensor:
        """mu_u of regions that have so many counted pixels of the hand, (B, U)."""
        share_of = self._share_of
        if share_of == "auto":
            share_of = "region" if regions.membership is None else "hand"
        if share_of == "hand":
            whole = hand.flatten(1).sum(dim=1, keepdim=True).to(pixels)
        else:
            whole = regions.sizes().to(pixels)
        return pixels / whole.clamp(min=1.0)


def _region_means(values: Tensor, regions: Regions, counted: Tensor) -> tuple[Tensor, Tensor]:
    """Means of (B, H, W) values over the counted pixels of each region, and how many they are."""
    ones = counted.to(values)
    pixels = regions.sums(ones)
    return regions.sums(values * ones) / pixels.clamp(min=1.0), pixels


def binary_weights(hand: Tensor) -> Tensor:
    """(B, H, W) float32, 1 where y_h, bool or a coverage, is above a half, and 0 elsewhere."""
    return (hand if hand.dtype == torch.bool else hand > 0.5).float()


def _check_shapes(error: Tensor, regions: Regions, hand: Tensor, omega: Tensor) -> None:
    shapes = [tuple(tensor.shape) for tensor in (error, regions.index, hand)]
    if error.ndim != 3 or len(set(shapes)) > 1 or tuple(omega.shape) != shapes[0][:1]:
        raise ShapeMismatch(
            f"have the shapes {shapes} and {tuple(omega.shape)}, not (B, H, W) each and (B,)",
            field="error, regions, hand, omega",
        )
