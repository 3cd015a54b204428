"""Properties of single frames: their appearance, and how uncertain its pixels are."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import torch
from torch.nn.functional import softplus

#: Octaves of the Gaussians' numbers at the start; each is a sine and a cosine by axis.
OCTAVES = 4
#: Numbers that stand for a Gaussian.
GAUSSIAN_FEATURES = 6 * OCTAVES

# The network gives gain and offset by colour, uncertainty, transient colour, transient share.
_OUTPUTS = (3, 3, 1, 3, 1)
# Where softplus is 1, the uncertainty at the start.
_ONE = math.log(math.e - 1.0)
# The transient share starts at 5 %.
_RARE = -3.0


@dataclass(frozen=True, eq=False)
class Appearance:
    """How N Gaussians look in B frames."""

    #: (B, N, 3) sRGB without light, with the frame's gain and offset; within [0, 1].
    colors: torch.Tensor
    #: (B, N, 1) uncertainty, positive.
    uncertainty: torch.Tensor
    #: (B, N, 3) colour of what is only in this frame, in [0, 1].
    transient: torch.Tensor
    #: (B, N, 1) its share, in [0, 1].
    share: torch.Tensor


def start_appearance(
    places: torch.Tensor, frames: int, frame_features: int, hidden: int, seed: int
) -> dict[str, torch.Tensor]:
    """The tensors before the first step.

    Args:
        places: (N, 3) where the Gaussians are on the hand at rest, in the hand's own size: most
            coordinates lie in [0, 1].

    Returns:
        by name: `frame` (R, E), `gaussian` (N, 24), and the weights of three layers for `appear`.

    Source: the code of WildGaussians.
    """
    random, device = torch.Generator().manual_seed(seed), places.device

    def layer(outputs: int, inputs: int) -> torch.Tensor:
        values = 2.0 * torch.rand(outputs, inputs, generator=random) - 1.0
        return (values / math.sqrt(inputs)).to(device)

    octaves = 2.0 * math.pi * 2.0 ** torch.arange(OCTAVES, device=device)
    phases = (places[..., None] * octaves).flatten(1)
    inputs = 3 + GAUSSIAN_FEATURES + frame_features
    return {
        "frame": 0.01 * torch.randn(frames, frame_features, generator=random).to(device),
        "gaussian": torch.cat((phases.sin(), phases.cos()), dim=-1),
        "network.layer_1": layer(hidden, inputs),
        "network.bias_1": torch.zeros(hidden, device=device),
        "network.layer_2": layer(hidden, hidden),
        "network.bias_2": torch.zeros(hidden, device=device),
        "network.layer_3": layer(sum(_OUTPUTS), hidden),
        "network.bias_3": torch.zeros(sum(_OUTPUTS), device=device),
    }


def appear(
    tensors: Mapping[str, torch.Tensor],
    colors: torch.Tensor,
    frame: torch.Tensor,
    tone_scale: float,
) -> Appearance:
    """Change the colours of the Gaussians as some frames do; differentiable in all tensors.

    Args:
        tensors: as `start_appearance` names them.
        colors: (N, 3) sRGB without light.
        frame: (B, E) the numbers of B frames.
        tone_scale: factor on the gains and offsets.

    Source: Kulhanek et al., "WildGaussians", where the gain starts at 0; here it
    starts at 1, so that the first step is the plain fit's.
    """
    known = torch.cat((colors, tensors["gaussian"]), dim=-1)
    split = known.shape[-1]
    first = tensors["network.layer_1"]
    # The share of the frame is the same for all Gaussians.
    hidden = (known @ first[:, :split].T)[None] + (frame @ first[:, split:].T)[:, None]
    hidden = (hidden + tensors["network.bias_1"]).relu()
    hidden = (hidden @ tensors["network.layer_2"].T + tensors["network.bias_2"]).relu()
    made = (hidden @ tensors["network.layer_3"].T + tensors["network.bias_3"]).split(
        _OUTPUTS, dim=-1
    )
    gain, offset = 1.0 + tone_scale * made[0], tone_scale * made[1]
    return Appearance(
        colors=(colors * gain + offset).clamp(0.0, 1.0),
        uncertainty=softplus(made[2] + _ONE),
        transient=made[3].sigmoid(),
        share=(made[4] + _RARE).sigmoid(),
    )


def places_at_rest(corners: torch.Tensor, barycentric: torch.Tensor) -> torch.Tensor:
    """Where the Gaussians of one hand are at rest, in the hand's own size.

    Args:
        corners: (N, 3, 3) m, the corners of each anchor's triangle.
        barycentric: (N, 3).

    Returns:
        (N, 3), centred at 0.5; 97 % of the coordinates of each axis lie in [0, 1].
    """
    places = (corners * barycentric[..., None]).sum(dim=1)
    places = places - places.mean(dim=0)
    return 0.5 + 0.5 * places / torch.quantile(places.abs(), 0.97, dim=0)


# What the geometry gets of the gradient of the uncertainty: nothing that matters.
_LITTLE = 1e-4


def laplace_loss(error: torch.Tensor, sigma: torch.Tensor, least: float) -> torch.Tensor:
    """Negative log likelihood of errors under a Laplace distribution, without its constant."""
    return error / sigma + torch.log(sigma / least)


def gauss_loss(square: torch.Tensor, beta: torch.Tensor, least: float) -> torch.Tensor:
    """Negative log likelihood of errors under a normal distribution, without its constant.
    Returns:
        r^2 / (2 beta^2) + log(beta / least); smallest at beta = |r|.

    Source: Martin-Brualla et al., "NeRF in the Wild".
    """
    return square / (2.0 * beta.square()) + torch.log(beta / least)


def certain(sigma: torch.Tensor) -> torch.Tensor:
    """Whether 1 / (2 sigma^2) > 1: which pixels a fit keeps.

    Source: the code of WildGaussians.
    """
    return 2.0 * sigma.square() < 1.0


def before_drawing(channel: torch.Tensor) -> torch.Tensor:
    """The same values; their gradient gets back what `after_drawing` took off."""
    return _ScaledGradient.apply(channel, 1.0 / _LITTLE)


def after_drawing(channel: torch.Tensor) -> torch.Tensor:
    """The same values; their gradient is made small.

    The rasterizer draws the uncertainty with the colours in one pass. Between these two functions
    its gradient is so small that the Gaussians' places and opacities do not follow it: they are
    for the image, and a Gaussian must not move to where an error is.
    """
    return _ScaledGradient.apply(channel, _LITTLE)


class _ScaledGradient(torch.autograd.Function):
    """The identity with a factor on its gradient."""

    @staticmethod
    def forward(ctx: Any, values: torch.Tensor, factor: float) -> torch.Tensor:
        ctx.factor = factor
        return values.view_as(values)

    @staticmethod
    def backward(ctx: Any, gradient: torch.Tensor) -> tuple[torch.Tensor, None]:
        return gradient * ctx.factor, None
