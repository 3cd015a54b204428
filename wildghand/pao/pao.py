"""Perturbation-aware optimization: how much each pixel of a frame counts."""

from __future__ import annotations

import math
from dataclasses import dataclass, fields
from typing import Literal

import torch
from torch import Tensor, nn

from hwp_bench.base.errors import ShapeMismatch, UsageError
from wildghand.pao.regions.frame_regions import Regions

#: Colour channels: the paper's background error is their sum, its region error their mean.
_CHANNELS = 3.0
#: Errors that differ by less than this share are equal: stretching would show rounding.
_EQUAL = 1e-4


@dataclass(frozen=True)
class PaoSettings:
    """Perturbation-aware weights; the defaults are the paper's for a single hand."""

    #: "weights" is the paper's W; "binary" puts the hand's mask in its place (the paper's table).
    variant: Literal["weights", "binary"] = "weights"
    #: Factor of every region's weight.
    alpha: float = 100.0
    #: How strongly the temporal weight of a frame lowers its regions' weights; 0 = not at all.
    beta: float = 1000.0
    #: T_E at the start: regions with a mean error above it have weight 0.
    error_threshold: float = 1.0
    #: T_mu at the start: regions with a smaller share of hand have weight 0.
    share_threshold: float = 0.3
    #: T_b at the start: background pixels whose error, summed over channels, is above it have
    #: weight 0. The paper uses 3 for a single hand and 10 for interacting hands.
    background_threshold: float = 3.0
    #: What mu is a share of: "hand" = |region and hand| / |hand|, the paper's formula, which
    #: wants regions as large as a hand; "region" = |region and hand| / |region|, the paper's
    #: sentence, which superpixels can reach too. "auto" takes the formula where regions may
    #: overlap (Segment Anything's) and the sentence for a partition into superpixels.
    share_of: Literal["auto", "hand", "region"] = "auto"
    #: Stretch the errors of a batch's regions to [0, 1], as the authors do; equal ones become 0.
    normalise_errors: bool = True
    #: Weight outside the hand in the variant "binary".
    binary_outside: float = 0.0

    def __post_init__(self) -> None:
        for item in fields(self):
            value = getattr(self, item.name)
            if isinstance(value, float) and not (math.isfinite(value) and value >= 0.0):
                raise UsageError(
                    f"is {value}", field=item.name, remedy="Use a finite number, 0 or more."
                )
        for name, known in (
            ("variant", ("weights", "binary")),
            ("share_of", ("auto", "hand", "region")),
        ):
            if getattr(self, name) not in known:
                raise UsageError(
                    f"is {getattr(self, name)!r}", field=name, remedy=f"Use one of {known}."
                )


@dataclass(frozen=True, eq=False)
class Weights:
    """What the pixels of B frames count."""

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

    The thresholds want their own learning rate (the paper's is 1e-6). Gradients reach nothing
    but them: a gradient through the errors would reward errors that lower a weight, and omega
    is detached because a larger one would buy a lower loss.

    Source: WildGHand, section "Perturbation-aware Optimization", equations of lambda_u and W,
    read so that they are defined everywhere; `docs/dpd_pao.md` lists the differences.
    """

    def __init__(self, settings: PaoSettings = PaoSettings()) -> None:
        super().__init__()
        self.settings = settings
        self.T_E = nn.Parameter(torch.tensor(settings.error_threshold))
        self.T_mu = nn.Parameter(torch.tensor(settings.share_threshold))
        self.T_b = nn.Parameter(torch.tensor(settings.background_threshold))

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
        if self.settings.variant == "binary":
            lambdas = torch.zeros_like(errors)
            background = self.settings.binary_outside * outside
            weights = (on_hand & finite).to(error) + background
        else:
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


def _stretch(errors: Tensor, present: Tensor) -> Tensor:
    """Errors of the regions that are present, from their smallest to their largest, on [0, 1]."""
    if not bool(present.any()):
        return errors
    low, high = errors[present].aminmax()
    span = high - low
    stretched = (errors - low) / torch.where(span > 0.0, span, torch.ones_like(span))
    return torch.where(present & (span > _EQUAL * high), stretched, torch.zeros_like(errors))


def _check_shapes(error: Tensor, regions: Regions, hand: Tensor, omega: Tensor) -> None:
    shapes = [tuple(tensor.shape) for tensor in (error, regions.index, hand)]
    if error.ndim != 3 or len(set(shapes)) > 1 or tuple(omega.shape) != shapes[0][:1]:
        raise ShapeMismatch(
            f"have the shapes {shapes} and {tuple(omega.shape)}; (B, H, W) thrice and (B,) "
            "are wanted",
            field="error, regions, hand, omega",
        )
