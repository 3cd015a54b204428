"""L1 + D-SSIM and its gradient in one go on the CPU, float32: a third of torch's time.

The window is OpenCV's work; what lies between the two blurs is compiled, since torch would pass
over the same images some forty times.
"""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np
import torch

from hwp_bench.base.compiled import compiled


class PhotometricCpu(torch.autograd.Function):
    """See `wildghand.gaussians.losses.photometric_loss`, which checks the arguments."""

    @staticmethod
    def forward(
        ctx: Any,
        prediction: torch.Tensor,
        target: torch.Tensor,
        weights: torch.Tensor,
        dssim_weight: float,
        window: np.ndarray,
        stabilisers: tuple[float, float],
    ) -> torch.Tensor:
        """Return the scalar loss; the gradients are made along with it."""
        x, y, w = (
            np.ascontiguousarray(tensor.detach().numpy())
            for tensor in (prediction, target, weights)
        )
        errors = np.empty(w.shape, np.float32)
        gradient = np.empty_like(x) if ctx.needs_input_grad[0] else None
        for image in range(len(x)):
            _one_image(
                x[image],
                y[image],
                w[image] / np.float32(x.size),
                np.float32(dssim_weight),
                window,
                np.array(stabilisers, np.float32),
                errors[image],
                None if gradient is None else gradient[image],
            )
        ctx.gradient = gradient
        ctx.save_for_backward(torch.from_numpy(errors))
        ctx.count = x.size
        total = np.einsum("bhw,bhw->", errors, w, dtype=np.float64)
        return torch.tensor(total / x.size, dtype=torch.float32)

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx: Any, upstream: torch.Tensor) -> tuple[torch.Tensor | None, ...]:
        """Scale the gradients that `forward` has left."""
        (errors,) = ctx.saved_tensors
        to_prediction = to_weights = None
        if ctx.needs_input_grad[0]:
            to_prediction = torch.from_numpy(ctx.gradient) * upstream
        if ctx.needs_input_grad[2]:
            to_weights = errors * (upstream / ctx.count)
        return to_prediction, None, to_weights, None, None, None


def warm_up() -> None:
    """Make the kernels ready: compiled once on a machine, loaded later."""
    image, mask = np.zeros((1, 1, 3), np.float32), np.zeros((1, 1), np.float32)
    weight, window, stabilisers = np.float32(0.5), np.ones(1), np.ones(2, np.float32)
    _one_image(image, image, mask, weight, window, stabilisers, mask.copy(), image.copy())


def _one_image(
    x: np.ndarray,
    y: np.ndarray,
    weights: np.ndarray,
    dssim_weight: np.float32,
    window: np.ndarray,
    stabilisers: np.ndarray,
    errors: np.ndarray,
    gradient: np.ndarray | None,
) -> None:
    """Fill the errors of one image, summed over channels, and the gradient of their sum.

    Args:
        x, y: (H, W, C).
        weights: (H, W), divided by the number of values of the batch.
        dssim_weight: lambda.
        window: (11,).
        stabilisers: C1 and C2 of SSIM.
        errors: (H, W), filled.
        gradient: (H, W, C), filled; None if not needed.
    """
    height, width, channels = x.shape

    def rows(count: int) -> np.ndarray:
        return np.empty((height, width, count * channels), np.float32)

    def blur(image: np.ndarray) -> np.ndarray:
        return cv2.sepFilter2D(image, -1, window, window, borderType=cv2.BORDER_CONSTANT)

    moments, factors, direct = rows(5), rows(3), rows(1)
    _multiply(x, y, moments)
    _compare(
        blur(moments).reshape(moments.shape),
        x,
        y,
        weights,
        dssim_weight,
        stabilisers,
        errors,
        factors,
        direct,
    )
    if gradient is not None:
        # The window is symmetric and the border zero: blurring is its own adjoint.
        _gather(blur(factors).reshape(factors.shape), x, y, direct, gradient)


@compiled()
def _multiply(x: np.ndarray, y: np.ndarray, moments: np.ndarray) -> None:
    height, width, channels = x.shape
    for row in range(height):
        for column in range(width):
            for c in range(channels):
                a = x[row, column, c]
                b = y[row, column, c]
                moments[row, column, c] = a
                moments[row, column, channels + c] = b
                moments[row, column, 2 * channels + c] = a * a
                moments[row, column, 3 * channels + c] = b * b
                moments[row, column, 4 * channels + c] = a * b


@compiled()
def _compare(
    moments: np.ndarray,
    x: np.ndarray,
    y: np.ndarray,
    weights: np.ndarray,
    dssim_weight: np.float32,
    stabilisers: np.ndarray,
    errors: np.ndarray,
    factors: np.ndarray,
    direct: np.ndarray,
) -> None:
    one, two, zero = np.float32(1), np.float32(2), np.float32(0)
    c1, c2 = stabilisers[0], stabilisers[1]
    l1_weight = one - dssim_weight
    height, width, channels = x.shape
    for row in range(height):
        for column in range(width):
            weight = weights[row, column]
            total = zero
            for c in range(channels):
                mu_x = moments[row, column, c]
                mu_y = moments[row, column, channels + c]
                mu_xy = mu_x * mu_y
                squares = mu_x * mu_x + mu_y * mu_y
                a1 = two * mu_xy + c1
                a2 = two * (moments[row, column, 4 * channels + c] - mu_xy) + c2
                b1 = squares + c1
                spread = (
                    moments[row, column, 2 * channels + c]
                    + moments[row, column, 3 * channels + c]
                    - squares
                )
                b2 = max(spread, zero) + c2
                inverse = one / (b1 * b2)
                ssim = a1 * a2 * inverse
                difference = x[row, column, c] - y[row, column, c]
                total += l1_weight * abs(difference) + dssim_weight * (one - ssim)
                sign = one if difference > zero else (-one if difference < zero else zero)
                direct[row, column, c] = weight * l1_weight * sign
                scale = -weight * dssim_weight
                share1 = b2 * inverse
                share2 = b1 * inverse
                factors[row, column, c] = (
                    scale * two * (mu_y * (a2 - a1) * inverse - mu_x * ssim * (share1 - share2))
                )
                factors[row, column, channels + c] = -scale * ssim * share2
                factors[row, column, 2 * channels + c] = scale * two * a1 * inverse
            errors[row, column] = total


@compiled()
def _gather(
    blurred: np.ndarray, x: np.ndarray, y: np.ndarray, direct: np.ndarray, gradient: np.ndarray
) -> None:
    two = np.float32(2)
    height, width, channels = x.shape
    for row in range(height):
        for column in range(width):
            for c in range(channels):
                gradient[row, column, c] = (
                    direct[row, column, c]
                    + blurred[row, column, c]
                    + two * x[row, column, c] * blurred[row, column, channels + c]
                    + y[row, column, c] * blurred[row, column, 2 * channels + c]
                )
