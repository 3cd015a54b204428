"""Losses on images: SSIM with a closed-form gradient, and L1 + D-SSIM under pixel weights."""

from __future__ import annotations

import functools
from typing import Any

import numpy as np
import torch

from hwp_bench.base.errors import ShapeMismatch

#: Edge of the SSIM window, px.
WINDOW = 11
#: Standard deviation of the SSIM window, px.
SIGMA = 1.5
#: Stabilisers (0.01 L)^2 and (0.03 L)^2 for a data range L of 1.
C1, C2 = 0.01**2, 0.03**2


def ssim_map(prediction: torch.Tensor, target: torch.Tensor) -> torch.Tensor:
    """Structural similarity at every pixel and channel.

    Half precision is computed and returned in float32: its variances would be rounding alone.
    The window is a Gaussian of 11 px and sigma 1.5; population covariance; data range 1; beyond
    the border both images are 0. The gradient goes to `prediction` only.

    Args:
        prediction: (B, H, W, C) float.
        target: (B, H, W, C) float of the same type.

    Returns:
        (B, H, W, C) in [-1, 1].

    Raises:
        ShapeMismatch: the two differ in shape.

    Source: Wang et al., "Image quality assessment: from error visibility to structural
    similarity", equation 13; zero padding as in 3DGS.
    """
    _same_shape(prediction, target, "target")
    return _SsimMap.apply(full_precision(prediction), full_precision(target))


def photometric_loss(
    prediction: torch.Tensor,
    target: torch.Tensor,
    weights: torch.Tensor,
    dssim_weight: float,
) -> torch.Tensor:
    """(1 - lambda) L1 + lambda (1 - SSIM), weighted by pixel, averaged over pixels and channels.

    Args:
        prediction: (B, H, W, C) float, sRGB in [0, 1].
        target: (B, H, W, C), as `prediction`.
        weights: (B, H, W) not negative.
        dssim_weight: lambda in [0, 1]; with 0 only L1 is computed.

    Returns:
        scalar, float32 for half precision: the weighted sum divided by the number of values
        B H W C, so that a pixel counts the same in every frame. Differentiable in `prediction`
        and `weights`.

    Raises:
        ShapeMismatch: the three do not describe the same images.

    Source: Kerbl et al., "3D Gaussian Splatting", equation 7.
    """
    _same_shape(prediction, target, "target")
    if weights.shape != prediction.shape[:3]:
        raise ShapeMismatch(
            f"has shape {tuple(weights.shape)}, expected {tuple(prediction.shape[:3])}",
            field="weights",
        )
    prediction, target, weights = (
        full_precision(prediction),
        full_precision(target),
        full_precision(weights),
    )
    images = (prediction, target, weights)
    if dssim_weight > 0.0 and prediction.device.type == "cpu":
        from wildghand.gaussians.photometric_cpu import PhotometricCpu, takes

        if takes(*images):
            return PhotometricCpu.apply(*images, dssim_weight, _window(), (C1, C2))
    error = (prediction - target).abs()
    if dssim_weight > 0.0:
        dissimilarity = 1.0 - ssim_map(prediction, target)
        error = (1.0 - dssim_weight) * error + dssim_weight * dissimilarity
    return (error * weights[..., None]).mean()


def full_precision(values: torch.Tensor) -> torch.Tensor:
    """Half precision as float32; gradients come back in the type that was given."""
    return values.float() if values.element_size() < 4 else values


class _SsimMap(torch.autograd.Function):
    """SSIM and its derivative; autograd's own would blur twice as often and keep twice as much."""

    @staticmethod
    def forward(ctx: Any, prediction: torch.Tensor, target: torch.Tensor) -> torch.Tensor:
        x, y = prediction.detach(), target.detach()
        channels = x.shape[-1]
        stack = torch.cat((x, y, x * x, y * y, x * y), dim=-1)
        mu_x, mu_y, xx, yy, xy = _blur(stack).split(channels, dim=-1)
        mu_xx, mu_yy, mu_xy = mu_x * mu_x, mu_y * mu_y, mu_x * mu_y
        a1 = 2.0 * mu_xy + C1
        a2 = 2.0 * (xy - mu_xy) + C2
        b1 = mu_xx + mu_yy + C1
        # Rounding may push a variance below 0; the sum must stay away from it.
        b2 = (xx - mu_xx + yy - mu_yy).clamp(min=0.0) + C2
        inverse = 1.0 / (b1 * b2)
        ssim = a1 * a2 * inverse
        ctx.save_for_backward(x, y, mu_x, mu_y, a1, a2, b1, b2, inverse, ssim)
        return ssim

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx: Any, gradient: torch.Tensor) -> tuple[torch.Tensor, None]:
        x, y, mu_x, mu_y, a1, a2, b1, b2, inverse, ssim = ctx.saved_tensors
        channels = x.shape[-1]
        to_mu = 2.0 * (mu_y * (a2 - a1) * inverse - mu_x * ssim * (1.0 / b1 - 1.0 / b2))
        to_xx = -ssim / b2
        to_xy = 2.0 * a1 * inverse
        stack = torch.cat((gradient * to_mu, gradient * to_xx, gradient * to_xy), dim=-1)
        # The window is symmetric and the border zero: blurring is its own adjoint.
        from_mu, from_xx, from_xy = _blur(stack).split(channels, dim=-1)
        return from_mu + 2.0 * x * from_xx + y * from_xy, None


def _blur(images: torch.Tensor) -> torch.Tensor:
    """Blur (B, H, W, C) with the SSIM window over a zero border."""
    if images.device.type != "cpu":
        return _convolve(images)
    import cv2

    # An order of magnitude faster on a CPU than torch's convolution of single channels.
    source = np.ascontiguousarray(images.numpy())
    blurred = np.empty_like(source)
    window = _window()
    for image, out in zip(source, blurred, strict=True):
        cv2.sepFilter2D(image, -1, window, window, dst=out, borderType=cv2.BORDER_CONSTANT)
    return torch.from_numpy(blurred)


def _convolve(images: torch.Tensor) -> torch.Tensor:
    window = _window_on(images.device, images.dtype)
    channels = images.shape[-1]
    half = WINDOW // 2
    planes = images.permute(0, 3, 1, 2)
    for size, padding in (((WINDOW, 1), (half, 0)), ((1, WINDOW), (0, half))):
        kernel = window.reshape(1, 1, *size).expand(channels, 1, *size)
        planes = torch.nn.functional.conv2d(planes, kernel, padding=padding, groups=channels)
    return planes.permute(0, 2, 3, 1)


@functools.cache
def _window() -> np.ndarray:
    places = np.arange(WINDOW) - WINDOW // 2
    window = np.exp(-0.5 * (places / SIGMA) ** 2)
    return window / window.sum()


@functools.cache
def _window_on(device: torch.device, dtype: torch.dtype) -> torch.Tensor:
    return torch.as_tensor(_window(), dtype=dtype, device=device)


def _same_shape(prediction: torch.Tensor, other: torch.Tensor, field: str) -> None:
    if prediction.dim() != 4 or prediction.shape != other.shape:
        raise ShapeMismatch(
            f"has shape {tuple(other.shape)}, the prediction {tuple(prediction.shape)}; "
            "both must be (B, H, W, C)",
            field=field,
        )
