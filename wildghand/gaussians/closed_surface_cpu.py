"""`wildghand.gaussians.closed_surface` on the CPU, float32: one compiled pass, on all threads."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import torch
from torch import Tensor

from wildghand.gaussians import closed_surface_kernels as kernels
from wildghand.gaussians.attributes import CHANNELS, Activation
from wildghand.splat.threads import piece_count, run_pieces

#: A Gaussian here takes as long as so many of those that `thread_count` counts.
_WEIGHT = 2


class OffSurfaceCpu(torch.autograd.Function):
    """Sum of the costs over all Gaussians, divided by their number."""

    @staticmethod
    def forward(
        ctx: Any,
        raw: Tensor,
        activation: Activation,
        spacing: float,
        free: tuple[float, ...],
        tiny: float,
    ) -> Tensor:
        """Return the mean cost of (..., N, 14) raw attributes; `free` as the kernel takes it."""
        given = raw.detach().contiguous().view(-1, CHANNELS)
        made, count = torch.empty_like(given), len(given)
        costs = np.zeros(piece_count(count, kernels.PIECE))
        least, greatest = math.log(activation.min_scale), math.log(activation.max_scale)
        run_pieces(
            kernels.off_surface,
            count,
            kernels.PIECE,
            _WEIGHT * count,
            given.numpy(),
            np.array([activation.max_offset, spacing], np.float32),
            np.array([activation.log_scale_bias, least, greatest], np.float32),
            np.array(free, np.float32),
            np.float32(tiny),
            made.numpy(),
            costs,
        )
        ctx.save_for_backward(made)
        ctx.shape = raw.shape
        return raw.new_tensor(costs.sum() / count)

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx: Any, gradient: Tensor) -> tuple[Tensor | None, ...]:
        """Gradient of the raw attributes."""
        (made,) = ctx.saved_tensors
        return (made * (gradient / len(made))).view(ctx.shape), None, None, None, None
