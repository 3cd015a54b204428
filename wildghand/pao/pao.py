"""Perturbation-aware optimization: how much each pixel of a frame counts.

Weights follow the errors of regions. An error is counted in what is ordinary: the running median of
all regions, or the ordinary error of the region's places on the hand.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import ClassVar, Literal

import torch
from torch import Tensor, nn

from hwp_bench.base.errors import ShapeMismatch
from hwp_bench.methods.settings import check_source, number
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


#: T_b at the start, for one hand and for two, as the authors have it: background pixels whose
#: error, summed over channels, is above it have weight 0.
BACKGROUND_THRESHOLDS = (3.0, 10.0)
#: Colour channels: the paper's background error is their sum, its region error their mean.
_CHANNELS = 3.0
#: Errors that differ by less than this share are equal: stretching would show rounding.
_EQUAL = 1e-4


@dataclass(frozen=True)
class PaoSettings:
    """Perturbation-aware weights; the modes `paper` and `released` have the paper's numbers."""

    #: Component: weigh frames and regions. Without it a pixel counts as the estimated mask says.
    enabled: bool = True
    #: `scaled`: the paper's equations with weights up to alpha on the hand, and the constant
    #: `terms.outside_weight` outside. `printed`: as printed. `binary`: the hand's mask alone (the
    #: paper's table).
    variant: Literal["scaled", "printed", "binary"] = "scaled"
    #: The regions y_u: `superpixels`, or `sam:PATH`, the masks of a Segment Anything checkpoint.
    regions: str = "superpixels"
    #: The hand y_h: the `estimated` mask of the capture; `graph-cut`, prompted by the projected
    #: hand; or `sam:PATH`, Segment Anything at the projected hand root, as in the paper.
    hand: str = "estimated"
    #: What the temporal factor 1 / (1 + beta |omega|) scales. `teaching`: what the canonical hand
    #: learns from a frame, while the frame's biases learn from all of it. `all`: W. `regions`: the
    #: weights of regions alone, as printed. `none`: nothing, as in the authors' code.
    temporal: Literal["teaching", "all", "regions", "none"] = "teaching"
    #: What E_u is counted in. `place`: the ordinary error of the region's places on the hand
    #: (`wildghand.pao.pao`). `median`: the running median of the regions' errors.
    #: `batch`: from the smallest to the largest of a batch on [0, 1], as the authors do.
    #: `absolute`: colours in [0, 1], as printed.
    errors: Literal["place", "median", "batch", "absolute"] = "place"
    #: How strongly the temporal weight of a frame lowers its weight; 0 = not at all.
    beta: float = number(100.0)
    #: T_E at the start: regions with a mean error above it have weight 0.
    error_threshold: float = number(3.0)
    #: T_mu at the start: regions with a smaller share of hand have weight 0.
    share_threshold: float = number(0.0)

    #: How far a mismatch that every frame of the clip shares lifts the weights of regions towards
    #: 1 (`wildghand.prepass.FrameAssessment.shared_mismatch`), with `errors` "place".
    mismatch: ClassVar[float] = 1.0
    #: Lift the weights of a frame's regions towards 1 by the probability that the frame is clean,
    #: as the pre-pass judges, with `errors` "place": a large error there is a fault of the fit.
    spare_clean: ClassVar[bool] = True
    #: Weight outside the hand in the variant `binary`: the paper gives no formula.
    binary_outside: ClassVar[float] = 0.0

    def __post_init__(self) -> None:
        check_source(self.regions, "regions", ("superpixels",), ("sam",))
        check_source(self.hand, "hand", ("estimated", "graph-cut"), ("sam",))

    @property
    def alpha(self) -> float:
        """Factor of every region's weight; as printed it is that of the authors' code."""
        return 100.0 if self.variant == "printed" else 1.0


#: The equations as printed, with the paper's thresholds; beta, which it does not print, is that of
#: the authors' code.
PAPER_PAO = PaoSettings(
    variant="printed",
    temporal="regions",
    errors="absolute",
    beta=1000.0,
    error_threshold=1.0,
    share_threshold=0.3,
)


@dataclass(frozen=True, eq=False)
class Weights:
    """Weights of the pixels of B frames, and what they are made of."""

    #: (B, H, W) W, not negative.
    weights: Tensor
    #: (B, H, W) its background term, 0 on the hand.
    background: Tensor
    #: (B, U) lambda_u.
    lambdas: Tensor
    #: (B, U) E_u, as compared with T_E; 0 where a region has no hand.
    errors: Tensor
    #: (B, U) the regions' mean errors before they were counted in anything.
    mean_errors: Tensor
    #: (B, U) mu_u in [0, 1].
    shares: Tensor
    #: (B,) 1 / (1 + beta |omega|) in (0, 1].
    temporal: Tensor
    #: (B,) means of W, which -lambda_W |W| rewards. With `temporal` "all" omega has a gradient
    #: here, and nowhere else.
    sizes: Tensor


class PerturbationAwareWeights(nn.Module):
    """lambda_u and W from the error of the current rendering, with learnable thresholds.

    Args:
        settings: factors, and the thresholds at the start.
        hands: one or two; the background threshold differs.
        share_of: what mu is a share of. "hand" is the paper's formula, |region and hand| / |hand|,
            which needs regions as large as a hand; "region" its sentence, |region and hand| /
            |region|, which superpixels can reach too. "auto" takes the formula where regions may
            overlap (Segment Anything's) and the sentence for a partition into superpixels.

    The thresholds need their own learning rate (the paper's is 1e-6). Gradients reach nothing
    but them: a gradient through the errors would reward errors that lower a weight, and a gradient
    through omega a larger omega. The size of W, which the loss rewards, has one of omega: as
    printed it draws omega to 0.

    Source: WildGHand, section "Perturbation-aware Optimization", equations of lambda_u and W,
    read so that they are defined everywhere; `docs/dpd_pao.md` lists the differences.
    """

    def __init__(
        self,
        settings: PaoSettings = PaoSettings(),
        hands: int = 1,
        *,
        share_of: Literal["auto", "hand", "region"] = "auto",
    ) -> None:
        super().__init__()
        self.settings, self._share_of = settings, share_of
        self.T_E = nn.Parameter(torch.tensor(settings.error_threshold))
        self.T_mu = nn.Parameter(torch.tensor(settings.share_threshold))
        self.T_b = nn.Parameter(torch.tensor(BACKGROUND_THRESHOLDS[hands > 1]))

    def forward(
        self,
        error: Tensor,
        regions: Regions,
        hand: Tensor,
        omega: Tensor,
        median: float | Tensor | None = None,
        expected: Tensor | None = None,
    ) -> Weights:
        """Weigh B frames.

        Args:
            error: (B, H, W) mean over channels of |rendering - input|; a pixel that is not
                finite gets weight 0 and counts in no region. Half precision, here and in omega
                and `expected`, is computed in float32: float16 overflows in sums over a region.
            regions: y_u of the frames.
            hand: (B, H, W) y_h: bool, or coverage in [0, 1], hand where above a half.
            omega: (B,) temporal weights.
            median: running median of `Weights.mean_errors`; None: that of these frames. Only
                `errors` "median" and "place" read it.
            expected: (B, H, W) ordinary error at each pixel, positive, in which `errors` "place"
                counts; None: `median` is.

        Raises:
            ShapeMismatch: the arguments do not describe the same frames.
        """
        _check_shapes(error, regions, hand, omega)
        error, omega = full_precision(error.detach()), full_precision(omega)
        expected = None if expected is None else full_precision(expected)
        on_hand = hand if hand.dtype == torch.bool else hand > 0.5
        # Off the CPU the question would wait for the device.
        sound = error.device.type == "cpu" and bool(error.sum().isfinite())
        finite = None if sound else error.isfinite()
        counted = on_hand
        if finite is not None:
            error = torch.where(finite, error, torch.zeros_like(error))
            counted = on_hand & finite
        means, shares, present = self._measure(error, regions, counted, on_hand)
        if expected is not None and self.settings.errors == "place":
            ordinary, _ = _region_means(expected, regions, counted)
            errors = torch.where(
                present, means / ordinary.clamp(min=LEAST), torch.zeros_like(means)
            )
        else:
            errors = self._counted(means, present, median)
        live = self.temporal_factor(omega)
        temporal = live.detach()
        of_regions = temporal if self.settings.temporal in ("all", "regions") else None
        gates = self._gates(errors, shares)
        # A region without hand has no error; it must stay out even if T_mu learns to be < 0.
        lambdas = self.settings.alpha * gates * (shares > 0.0)
        lambdas = lambdas if of_regions is None else lambdas * of_regions[:, None]
        weights = regions.spread(lambdas)
        if self.settings.variant == "scaled":
            background = torch.zeros_like(error)
            weights = weights * hand
        else:
            background = ~on_hand * torch.relu(self.T_b - _CHANNELS * error)
            if self.settings.temporal == "all":
                background = background * temporal[:, None, None]
            weights = weights + background
        if finite is not None:
            weights, background = weights * finite, background * finite
        sizes = weights.mean(dim=(1, 2))
        if self.settings.temporal == "all":
            # Its value is that of W; its gradient reaches omega.
            sizes = sizes * (live / temporal)
        return Weights(weights, background, lambdas, errors, means, shares, temporal, sizes)

    def temporal_factor(self, omega: Tensor) -> Tensor:
        """1 / (1 + beta |omega|), in (0, 1]; the paper's has no absolute value.

        Args:
            omega: (B,) temporal weights.
        """
        return 1.0 / (1.0 + self.settings.beta * omega.abs())

    def _gates(self, errors: Tensor, shares: Tensor) -> Tensor:
        """kappa(T_E - E_u) kappa(mu_u - T_mu), (B, U); `scaled`: at most 1."""
        found = torch.relu(self.T_E - errors) * torch.relu(shares - self.T_mu)
        if self.settings.variant != "scaled":
            return found
        most = self.T_E.detach() * (1.0 - self.T_mu.detach())
        return found / most.clamp(min=1e-6)

    def _counted(self, means: Tensor, present: Tensor, median: float | Tensor | None) -> Tensor:
        """E_u in what the settings say, (B, U)."""
        if self.settings.errors == "batch":
            return _stretch(means, present)
        if self.settings.errors == "absolute":
            return means
        unit = running_median(None, means, present) if median is None else median
        return means / unit

    @torch.no_grad()
    def _measure(
        self, error: Tensor, regions: Regions, counted: Tensor, on_hand: Tensor
    ) -> tuple[Tensor, Tensor, Tensor]:
        """The regions' mean errors, mu_u, and which have any hand, (B, U) each."""
        errors, pixels = _region_means(error, regions, counted)
        share_of = self._share_of
        if share_of == "auto":
            share_of = "region" if regions.membership is None else "hand"
        if share_of == "hand":
            whole = on_hand.flatten(1).sum(dim=1, keepdim=True).to(error)
        else:
            whole = regions.sizes().to(error)
        return errors, pixels / whole.clamp(min=1.0), pixels > 0.0


def _region_means(values: Tensor, regions: Regions, counted: Tensor) -> tuple[Tensor, Tensor]:
    """Means of (B, H, W) values over the counted pixels of each region, and how many they are."""
    ones = counted.to(values)
    pixels = regions.sums(ones)
    return regions.sums(values * ones) / pixels.clamp(min=1.0), pixels


def binary_weights(hand: Tensor, outside: float = 0.0) -> Tensor:
    """The hand's mask as weights.

    Args:
        hand: (B, H, W) y_h: bool, or coverage in [0, 1], hand where above a half.

    Returns:
        (B, H, W) float32, 1 on the hand.
    """
    on_hand = hand if hand.dtype == torch.bool else hand > 0.5
    return on_hand.float() + outside * (~on_hand).float()


def _stretch(errors: Tensor, present: Tensor) -> Tensor:
    """Errors of the regions that are present, from their smallest to their largest, on [0, 1]."""
    if not errors.numel():
        return errors
    # Without a region that is present the span is minus infinity, and all is 0.
    low = torch.where(present, errors, math.inf).amin()
    high = torch.where(present, errors, -math.inf).amax()
    span = high - low
    stretched = (errors - low) / torch.where(span > 0.0, span, torch.ones_like(span))
    return torch.where(present & (span > _EQUAL * high), stretched, torch.zeros_like(errors))


def _check_shapes(error: Tensor, regions: Regions, hand: Tensor, omega: Tensor) -> None:
    shapes = [tuple(tensor.shape) for tensor in (error, regions.index, hand)]
    if error.ndim != 3 or len(set(shapes)) > 1 or tuple(omega.shape) != shapes[0][:1]:
        raise ShapeMismatch(
            f"have the shapes {shapes} and {tuple(omega.shape)}, not (B, H, W) each and (B,)",
            field="error, regions, hand, omega",
        )
