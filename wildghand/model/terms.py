"""Terms of the fit's objective, each a mean, so that no weight depends on sizes."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from types import MappingProxyType
from typing import Any

import torch
from torch import Tensor

from hwp_bench.base.errors import ShapeMismatch
from hwp_bench.methods.settings import choice, number
from wildghand.gaussians.attributes import RawAttributes
from wildghand.gaussians.losses import photometric_loss

#: Share of D-SSIM at most, where the poses of a clip had to be corrected (`wildghand.poses`): what
#: lies some pixels off its place has its structure elsewhere.
DSSIM_INEXACT = 0.05
#: Weight within `off_surface` of what is thicker than a disc, where the poses of a clip had to be
#: corrected. Exact poses make no needles (docs/person.md).
SURFACE_INEXACT = 5.0


@dataclass(frozen=True)
class TermWeights:
    """Weights and forms of the terms that are not settings.

    The defaults are the authors' weights divided by their 100 for the reconstruction, but for
    the two terms that cost the clean fit several dB: opacity and silhouette.
    """

    #: Weighted reconstruction.
    reconstruction: float = 1.0
    #: `bias_size`: biases of the perturbation module.
    bias: float = 1e-3
    #: `distance_to_one` of the shadow coefficients.
    shadow: float = 1e-5
    #: `distance_to_one` of the opacities.
    opacity: float = 0.0
    #: `SurfaceLaplacian.offsets`: template offsets (head iii).
    laplacian_offsets: float = 1e-3
    #: `SurfaceLaplacian.roughness` of the log scales.
    laplacian_scales: float = 1e-3
    #: `SurfaceLaplacian.roughness` of the colours.
    laplacian_colors: float = 1e-3
    #: `silhouette`: coverage against the posed hands.
    silhouette: float = 0.0
    #: `weight_reward`: keeps PAO from weighing everything with 0.
    weight_reward: float = 5e-3
    #: `cross_hand`: texture features of the two hands, where there are two.
    cross_hand: float = 1e-3
    #: Distances to one are squared, and not the norms that Eq. 8 prints.
    squared_distances: bool = True
    #: As in the authors' code, the bias term is the square of the sum of the attributes' mean
    #: biases before omega, and the texture term of squares, in place of l1 norms.
    squared_sums: bool = False


#: The terms of Eq. 7 and 8. The paper prints no weight for the reconstruction and the texture term:
#: these two are the authors'.
_PAPER = TermWeights(
    reconstruction=100.0,
    bias=0.1,
    shadow=0.001,
    opacity=0.1,
    laplacian_offsets=0.1,
    laplacian_scales=0.0,
    laplacian_colors=0.0,
    weight_reward=0.5,
    cross_hand=0.1,
    squared_distances=False,
)
#: By the setting `terms.weights`.
WEIGHTS: Mapping[str, TermWeights] = MappingProxyType(
    {
        "ours": TermWeights(),
        "paper": _PAPER,
        "released": replace(
            _PAPER,
            laplacian_scales=0.1,
            laplacian_colors=0.1,
            silhouette=1.0,
            squared_distances=True,
            squared_sums=True,
        ),
    }
)


@dataclass(frozen=True)
class TermSettings:
    """The terms of the loss."""

    #: Weights and forms of the terms that are not named here: `ours`, those of the `paper`'s Eq. 7
    #: and 8, or those of the authors' code (`released`).
    weights: str = choice("ours", "paper", "released")
    #: Share of D-SSIM in the reconstruction; the rest is L1.
    dssim_weight: float = number(0.2, 0.0, 1.0)
    #: Weight in the reconstruction of a pixel outside the visible-hand mask; inside it is 1.
    outside_weight: float = number(0.03, 0.0, 1.0)
    #: Leave out of the reconstruction what the mask leaves out though the posed hand covers it:
    #: there something is in front of the hand (`wildghand.fitting.judging`).
    leave_hidden: bool = True
    #: `off_surface`: what keeps Gaussians from being opaque discs that lie on the skin.
    surface: float = number(5e-4, 0.0, 1e6)
    #: A perceptual distance (`wildghand.gaussians.perceptual`).
    perceptual: float = number(0.0, 0.0, 1e6)

    @property
    def fixed(self) -> TermWeights:
        """The weights that are not settings."""
        return WEIGHTS[self.weights]

    def dssim_share(self, *, exact_poses: bool) -> float:
        """Share of D-SSIM in the reconstruction, of clips with exact poses or of others."""
        return self.dssim_weight if exact_poses else min(self.dssim_weight, DSSIM_INEXACT)


def reconstruction(
    prediction: Tensor, target: Tensor, weights: Tensor, dssim_weight: float = 0.0
) -> Tensor:
    """Weighted L1, with a share of D-SSIM; pixels that are not finite in the target are left out.

    Args:
        prediction: (B, H, W, 3) float, sRGB.
        target: (B, H, W, 3) float of the same type.
        weights: (B, H, W) W, not negative.
        dssim_weight: share of 1 - SSIM in [0, 1]; the paper has 0.
    """
    if prediction.shape == target.shape and weights.shape == target.shape[:-1]:
        finite = target.isfinite()
        # Off the CPU nobody waits to learn whether there is anything to leave out.
        if target.device.type != "cpu" or not bool(finite.all()):
            target = torch.where(finite, target, prediction.detach())
            weights = weights * finite.all(dim=-1)
    return photometric_loss(prediction, target, weights, dssim_weight)


def bias_size(biases: RawAttributes) -> Tensor:
    """Mean over Gaussians and frames of |Delta g|_1, the sum over the 14 channels."""
    return _BiasSize.apply(*(tensor for _, tensor in biases.items()))


class _BiasSize(torch.autograd.Function):
    """Sum of |x| over all tensors, divided by the number of Gaussians and frames."""

    @staticmethod
    def forward(ctx: Any, *tensors: Tensor) -> Tensor:
        ctx.save_for_backward(*tensors)
        ctx.count = tensors[0][..., 0].numel()
        return sum((tensor.abs().sum() for tensor in tensors), tensors[0].new_zeros(())) / ctx.count

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx: Any, gradient: Tensor) -> tuple[Tensor, ...]:
        share = gradient / ctx.count
        return tuple(tensor.sign().mul_(share) for tensor in ctx.saved_tensors)


def distance_to_one(values: Tensor, *, squared: bool = True) -> Tensor:
    """Mean of (x - 1)^2 or |x - 1|: for shadow coefficients and opacities, any shape."""
    away = values - 1.0
    return (away.square() if squared else away.abs()).mean()


def silhouette(coverage: Tensor, hand: Tensor) -> Tensor:
    """Mean of (alpha - s)^2; the authors', not in the paper.

    Args:
        coverage: (B, H, W) or (B, H, W, 1) alpha of the rendering.
        hand: (B, H, W) bool, s: where the posed mesh is, whatever covers it.
    """
    if coverage.ndim == hand.ndim + 1:
        coverage = coverage.squeeze(-1)
    if coverage.shape != hand.shape:
        raise ShapeMismatch(
            f"has shape {tuple(hand.shape)}, the coverage {tuple(coverage.shape)}", field="hand"
        )
    return (coverage - hand.to(coverage)).square().mean()


def gain_of_clean(log_gains: Tensor, clean: Tensor) -> Tensor:
    """Mean of the squared log gains, by how clean frames are.

    Clean frames have no gain: without this, gain and colours could trade places.

    Args:
        log_gains: (B, 3) of the frames' sRGB colours.
        clean: (B,) probability that a frame is clean.
    """
    return (clean * log_gains.square().mean(dim=-1)).mean()


def tint_of_gains(log_gains: Tensor) -> Tensor:
    """Mean squared distance of (B, 3) log gains from the mean of their frame's channels.

    A side of the hand that only perturbed frames show has a colour of its own, such as a palm's. A
    gain explains it as well as the hand does, and would take it away from the avatar.
    """
    return (log_gains - log_gains.mean(dim=-1, keepdim=True)).square().mean()


def weight_reward(sizes: Tensor) -> Tensor:
    """Minus the mean of W, from W or its means by frame: lowest where nothing is weighed down."""
    return -sizes.mean()


def cross_hand(left: Tensor, right: Tensor, *, squared: bool = False) -> Tensor:
    """Mean of |T_left - T_right| or its square: texture features of both hands, (N, F) each."""
    if left.shape != right.shape:
        raise ShapeMismatch(
            f"have the shapes {tuple(left.shape)} and {tuple(right.shape)}",
            field="left, right",
            remedy="Both hands need as many Gaussians.",
        )
    apart = left - right
    return (apart.square() if squared else apart.abs()).mean()
