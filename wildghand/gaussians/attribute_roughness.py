"""Roughness of log scales and colours over the hand's surface, with its gradient by hand.

Taken apart by autograd, the gradient of six channels would be joined from all fourteen.
"""

from __future__ import annotations

import math
from typing import Any

import torch
from torch import Tensor

from wildghand.gaussians.attributes import CHANNELS, SIZES
from wildghand.gaussians.laplacian import SurfaceLaplacian, sparse_times

_NAMES = list(SIZES)
_STARTS = {name: sum(SIZES[other] for other in _NAMES[:i]) for i, name in enumerate(_NAMES)}


def attribute_roughness(
    laplacian: SurfaceLaplacian, raw: Tensor, scales: float, colors: float
) -> Tensor:
    """`SurfaceLaplacian.roughness` of the raw log scales and of the sigmoid of the raw colours.

    Args:
        laplacian: of N anchors.
        raw: (B, N, 14) raw attributes of B frames.
        scales, colors: weights of the two.

    Returns:
        scalar: the weighted sum.
    """
    return _Roughness.apply(raw, laplacian.matrix, laplacian.transposed, scales, colors)


class _Roughness(torch.autograd.Function):
    """One product with the Laplacian forward, one with its transpose backward."""

    @staticmethod
    def forward(
        ctx: Any, raw: Tensor, matrix: Tensor, transposed: Tensor, scales: float, colors: float
    ) -> Tensor:
        frames, count = raw.shape[:2]
        parts = [_part(raw, "log_scales"), _part(raw, "logit_colors").sigmoid()]
        ctx.factors = math.sqrt(scales), math.sqrt(colors)
        values = torch.cat([p * f for p, f in zip(parts, ctx.factors, strict=True)], dim=-1)
        rows = values.movedim(1, 0).reshape(count, -1).to(matrix.dtype)
        differences = sparse_times(matrix, rows)
        ctx.save_for_backward(differences, parts[1], transposed)
        return differences.square().sum() / max(1, frames * count)

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx: Any, gradient: Tensor) -> tuple[Tensor | None, ...]:
        differences, colors, transposed = ctx.saved_tensors
        frames, count = colors.shape[:2]
        scale = gradient * (2.0 / max(1, frames * count))
        back = sparse_times(transposed, differences).view(count, frames, -1).movedim(0, 1)
        back = (back * scale).to(colors.dtype)
        of_raw = colors.new_zeros(frames, count, CHANNELS)
        wide = SIZES["log_scales"]
        torch.mul(back[..., :wide], ctx.factors[0], out=_part(of_raw, "log_scales"))
        slope = colors * (1.0 - colors) * ctx.factors[1]
        torch.mul(back[..., wide:], slope, out=_part(of_raw, "logit_colors"))
        return of_raw, None, None, None, None


def _part(raw: Tensor, name: str) -> Tensor:
    return raw.narrow(-1, _STARTS[name], SIZES[name])
