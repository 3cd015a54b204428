"""Losses that learn an uncertainty of each pixel, and how its gradient goes."""

from __future__ import annotations

from typing import Any

import torch

# What the geometry gets of the gradient of the uncertainty: nothing that matters.
_LITTLE = 1e-4


def laplace_loss(error: torch.Tensor, sigma: torch.Tensor, least: float) -> torch.Tensor:
    """Negative log likelihood of errors under a Laplace distribution, without its constant.

    Args:
        error: mean absolute error, of any shape, in units of `sigma`.
        sigma: at least `least`.
        least: makes the result 0 where an error of 0 has the least uncertainty.

    Returns:
        |r| / sigma + log(sigma / least); smallest at sigma = |r|.
    """
    return error / sigma + torch.log(sigma / least)


def gauss_loss(square: torch.Tensor, beta: torch.Tensor, least: float) -> torch.Tensor:
    """Negative log likelihood of errors under a normal distribution, without its constant.

    Args:
        square: squared error, of any shape, in units of `beta` squared.
        beta: at least `least`.
        least: makes the result 0 where an error of 0 has the least uncertainty.

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
