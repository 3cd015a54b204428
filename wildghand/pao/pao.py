"""Perturbation-aware optimization: how much each pixel of a frame counts."""

from __future__ import annotations

import math
from dataclasses import dataclass, fields
from typing import Literal

import torch
from torch import Tensor, nn

from hwp_bench.base.errors import ShapeMismatch, UsageError
from hwp_bench.methods.settings import number
from wildghand.pao.regions.frame_regions import Regions

#: Colour channels: the paper's background error is their sum, its region error their mean.
_CHANNELS = 3.0
#: Errors that differ by less than this share are equal: stretching would show rounding.
_EQUAL = 1e-4


@dataclass(frozen=True)
class PaoSettings:
    """Perturbation-aware weights; the numbers are the paper's."""

    #: Component: weigh frames and pixels. Without it a pixel counts as the estimated mask says.
    enabled: bool = True
    #: Where the weights come from. `judged`: the pre-pass, for frames and pixels. `paper`: the
    #: paper's equations, region by region. `binary`: the hand's mask (the paper's table).
    variant: Literal["judged", "paper", "binary"] = "judged"
    #: Addition to `judged`: robust weights of residuals later in the fit, in place of the
    #: pre-pass's pixel weights. Off: where it was measured it cost more than it brought
    #: (docs/wildghand.md).
    robust: bool = False
    #: Share of the budget after which residuals decide the weights.
    robust_start: float = number(0.25, 0.0, 1.0)
    #: Factor of every region's weight.
    alpha: float = 100.0
    #: How strongly the temporal weight of a frame lowers its regions' weights; 0 = not at all.
    beta: float = 1000.0
    #: T_E at the start: regions with a mean error above it have weight 0.
    error_threshold: float = 1.0
    #: T_mu at the start: regions with a smaller share of hand have weight 0.
    share_threshold: float = 0.3
    #: T_b at the start: background pixels whose error, summed over channels, is above it have
    #: weight 0. For a single hand.
    background_threshold: float = 3.0
    #: The same for two hands.
    background_threshold_both: float = 10.0
    #: What mu is a share of: "hand" = |region and hand| / |hand|, the paper's formula, which
    #: needs regions as large as a hand; "region" = |region and hand| / |region|, the paper's
    #: sentence, which superpixels can reach too. "auto" takes the formula where regions may
    #: overlap (Segment Anything's) and the sentence for a partition into superpixels.
    share_of: Literal["auto", "hand", "region"] = "auto"
    #: Stretch the errors of a batch's regions to [0, 1], as the authors do; equal ones become 0.
    normalise_errors: bool = True
    #: Weight outside the hand in the variant `binary`.
    binary_outside: float = 0.0

    def __post_init__(self) -> None:
        for item in fields(self):
            value = getattr(self, item.name)
            if isinstance(value, float) and not (math.isfinite(value) and value >= 0.0):
                raise UsageError(
                    f"is {value}", field=item.name, remedy="Use a finite number, 0 or more."
                )
        for name, known in (
            ("variant", ("judged", "paper", "binary")),
            ("share_of", ("auto", "hand", "region")),
        ):
            if getattr(self, name) not in known:
                raise UsageError(
                    f"is {getattr(self, name)!r}", field=name, remedy=f"Use one of {known}."
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
    #: (B, U) mu_u in [0, 1].
    shares: Tensor
    #: (B,) 1 / (1 + beta |omega|) in (0, 1].
    temporal: Tensor


class PerturbationAwareWeights(nn.Module):
    """lambda_u and W from the error of the current rendering, with learnable thresholds.

    Args:
        settings: factors, and the thresholds at the start.
        hands: one or two; the background threshold differs.

    The thresholds need their own learning rate (the paper's is 1e-6). Gradients reach nothing
    but them: a gradient through the errors would reward errors that lower a weight, and omega
    is detached because a larger one would buy a lower loss.

    Source: WildGHand, section "Perturbation-aware Optimization", equations of lambda_u and W,
    read so that they are defined everywhere; `docs/dpd_pao.md` lists the differences.
    """

    def __init__(self, settings: PaoSettings = PaoSettings(), hands: int = 1) -> None:
        super().__init__()
        self.settings = settings
        self.T_E = nn.Parameter(torch.tensor(settings.error_threshold))
        self.T_mu = nn.Parameter(torch.tensor(settings.share_threshold))
        background = settings.background_threshold
        if hands > 1:
            background = settings.background_threshold_both
        self.T_b = nn.Parameter(torch.tensor(background))

    def forward(self, error: Tensor, regions: Regions, hand: Tensor, omega: Tensor) -> Weights:
        """Weigh B frames.

        Args:
            error: (B, H, W) mean over channels of |rendering - input|; a pixel that is not
                finite gets weight 0 and counts in no region.
            regions: y_u of the frames.
            hand: (B, H, W) y_h: bool, or coverage in [0, 1], hand where above a half.
            omega: (B,) temporal weights.

        Raises:
            ShapeMismatch: the arguments do not describe the same frames.
        """
        _check_shapes(error, regions, hand, omega)
        error = error.detach()
        finite = error.isfinite()
        error = torch.where(finite, error, torch.zeros_like(error))
        on_hand = hand if hand.dtype == torch.bool else hand > 0.5
        errors, shares = self._measure(error, regions, on_hand & finite, on_hand)
        temporal = 1.0 / (1.0 + self.settings.beta * omega.detach().abs())
        outside = (finite & ~on_hand).to(error)
        gates = torch.relu(self.T_E - errors) * torch.relu(shares - self.T_mu)
        # A region without hand has no error; it must stay out even if T_mu learns to be < 0.
        lambdas = self.settings.alpha * gates * (shares > 0.0) * temporal[:, None]
        background = outside * torch.relu(self.T_b - _CHANNELS * error)
        weights = regions.spread(lambdas) * finite + background
        return Weights(weights, background, lambdas, errors, shares, temporal)

    @torch.no_grad()
    def _measure(
        self, error: Tensor, regions: Regions, counted: Tensor, on_hand: Tensor
    ) -> tuple[Tensor, Tensor]:
        """E_u and mu_u, (B, U) each."""
        pixels = regions.sums(counted.to(error))
        errors = regions.sums(error * counted) / pixels.clamp(min=1.0)
        if self.settings.normalise_errors:
            errors = _stretch(errors, pixels > 0.0)
        share_of = self.settings.share_of
        if share_of == "auto":
            share_of = "region" if regions.membership is None else "hand"
        if share_of == "hand":
            whole = on_hand.flatten(1).sum(dim=1, keepdim=True).to(error)
        else:
            whole = regions.sums(torch.ones_like(error))
        return errors, pixels / whole.clamp(min=1.0)


def binary_weights(hand: Tensor, outside: float = 0.0) -> Tensor:
    """The hand's mask as weights.

    Args:
        hand: (B, H, W) y_h: bool, or coverage in [0, 1], hand where above a half.
        outside: weight of the other pixels.

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
