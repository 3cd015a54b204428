"""L1 + D-SSIM and its gradient in one go on the CPU, float32: a tenth of torch's time."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch

from wildghand.gaussians.photometric_kernels import (
    LANES,
    Constants,
    Images,
    Made,
    compare,
    find_content,
    gather,
)
from wildghand.splat.threads import even_jobs, kernels_take, run, thread_count

# Values of an image that cost as much as one of the rasterizer's pairs.
_VALUES_LIKE_A_PAIR = 4


def takes(prediction: torch.Tensor, *others: torch.Tensor) -> bool:
    """Whether these images, (B, H, W, C), and their weights can be compared here."""
    wide = prediction.shape[2] * prediction.shape[3] >= LANES
    return wide and kernels_take(prediction, *others)


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
        count, height, width, channels = prediction.shape
        rows = (count, height, width * channels)
        x, y, w = (
            np.ascontiguousarray(tensor.detach().numpy())
            for tensor in (prediction, target, weights)
        )
        constants = Constants(
            np.asarray(window, np.float32),
            *(np.float32(value) for value in (dssim_weight, *stabilisers, x.size)),
        )
        images = Images(x.reshape(rows), y.reshape(rows), w, np.empty((count, 4), np.int64))
        made = Made(
            np.empty(w.shape, np.float32),
            np.empty((count, height)),
            np.empty(rows, np.float32),
            np.empty((3, *rows), np.float32),
        )
        run(
            find_content,
            even_jobs(count, thread_count(count, x.size // (4 * _VALUES_LIKE_A_PAIR))),
            images.x,
            images.y,
            channels,
            images.content,
        )
        jobs = even_jobs(
            count * height, thread_count(count * height, x.size // _VALUES_LIKE_A_PAIR)
        )
        run(compare, jobs, images, channels, constants, made)
        if ctx.needs_input_grad[0]:
            gradient = np.empty_like(x)
            run(gather, jobs, images, channels, constants.window, made, gradient.reshape(rows))
            ctx.gradient = gradient
        ctx.save_for_backward(torch.from_numpy(made.errors))
        ctx.count = x.size
        return torch.tensor(made.sums.sum() / x.size, dtype=torch.float32)

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
    image, mask = torch.zeros(1, 1, LANES, 1, requires_grad=True), torch.zeros(1, 1, LANES)
    window = np.ones(11, np.float32)
    PhotometricCpu.apply(image, image.detach(), mask, 0.5, window, (1.0, 1.0))
