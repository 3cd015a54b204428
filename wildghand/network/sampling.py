"""Reading a UV plane at fixed points, and gathering points in its cells."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor, nn
from torch.nn.functional import embedding_bag

from hwp_bench.errors import UsageError


class PlaneSampler(nn.Module):
    """Bilinear reading of a square plane at N fixed points.

    The points do not move, so texels and weights are computed once, for both directions: the
    gradient of a texel gathers from the points that read it. Nothing is scattered; the result
    is the same bit for bit every time.

    Args:
        uv: (N, 2) in [0, 1], origin at the bottom left.
        resolution: texels along each edge; their centres lie at (k + 0.5) / resolution, and
            points beyond the outermost centres read the border.

    Raises:
        UsageError: `resolution` is below 1.
    """

    index: Tensor
    weight: Tensor
    reader: Tensor
    reader_weight: Tensor
    reader_start: Tensor

    def __init__(self, uv: Tensor, resolution: int) -> None:
        super().__init__()
        if resolution < 1:
            raise UsageError(f"is {resolution}", field="resolution", remedy="Use 1 or more.")
        index, weight = bilinear_taps(uv, resolution)
        flat = index.flatten()
        order = torch.argsort(flat, stable=True)
        texels = torch.arange(resolution**2, dtype=flat.dtype, device=flat.device)
        buffers = {
            "index": index,
            "weight": weight,
            "reader": order // index.shape[1],
            "reader_weight": weight.flatten()[order],
            "reader_start": torch.searchsorted(flat[order], texels),
        }
        for name, tensor in buffers.items():
            self.register_buffer(name, tensor.contiguous(), persistent=False)

    def forward(self, plane: Tensor) -> Tensor:
        """Read the plane.

        Args:
            plane: (resolution^2, C), row by row from the top.

        Returns:
            (N, C).
        """
        return _Read.apply(
            plane, self.index, self.weight, self.reader, self.reader_weight, self.reader_start
        )


class _Read(torch.autograd.Function):
    """A weighted sum of rows, and its transpose as another one."""

    @staticmethod
    def forward(ctx: Any, plane: Tensor, *taps: Tensor) -> Tensor:
        index, weight, *reverse = taps
        ctx.save_for_backward(*reverse)
        return embedding_bag(
            index, plane.contiguous(), mode="sum", per_sample_weights=weight.to(plane.dtype)
        )

    @staticmethod
    def backward(ctx: Any, *grads: Tensor) -> tuple[Tensor | None, ...]:
        reader, weight, start = ctx.saved_tensors
        grad = grads[0].contiguous()
        into_plane = embedding_bag(
            reader, grad, start, mode="sum", per_sample_weights=weight.to(grad.dtype)
        )
        return into_plane, None, None, None, None, None


class CellPooling(nn.Module):
    """Means over the points of each cell of a square plane.

    Args:
        uv: (N, 2) in [0, 1], origin at the bottom left.
        resolution: cells along each edge.
    """

    cell: Tensor
    share: Tensor

    def __init__(self, uv: Tensor, resolution: int) -> None:
        super().__init__()
        column = (uv[:, 0] * resolution).long().clamp(0, resolution - 1)
        row = ((1.0 - uv[:, 1]) * resolution).long().clamp(0, resolution - 1)
        cell = row * resolution + column
        self.count = resolution**2
        self.register_buffer("cell", cell, persistent=False)
        members = torch.bincount(cell, minlength=self.count)
        self.register_buffer("share", 1.0 / members[cell].to(uv.dtype)[:, None], persistent=False)

    def forward(self, features: Tensor) -> Tensor:
        """Average.

        Args:
            features: (..., N, C).

        Returns:
            (..., resolution^2, C); 0 where a cell has no point.
        """
        shape = (*features.shape[:-2], self.count, features.shape[-1])
        weighted = features * self.share.to(features.dtype)
        return weighted.new_zeros(shape).index_add(-2, self.cell, weighted)


def bilinear_taps(uv: Tensor, resolution: int) -> tuple[Tensor, Tensor]:
    """The four texels around each point and their weights.

    Args:
        uv: (N, 2) in [0, 1], origin at the bottom left.
        resolution: texels along each edge.

    Returns:
        (N, 4) int64 row-major texel numbers, and (N, 4) weights that sum to 1.
    """
    x = (uv[:, 0] * resolution - 0.5).clamp(0.0, resolution - 1.0)
    y = ((1.0 - uv[:, 1]) * resolution - 0.5).clamp(0.0, resolution - 1.0)
    left, top = x.floor().long(), y.floor().long()
    right = (left + 1).clamp(max=resolution - 1)
    bottom = (top + 1).clamp(max=resolution - 1)
    across, down = x - left, y - top
    index = torch.stack(
        (
            top * resolution + left,
            top * resolution + right,
            bottom * resolution + left,
            bottom * resolution + right,
        ),
        dim=-1,
    )
    weight = torch.stack(
        (
            (1.0 - across) * (1.0 - down),
            across * (1.0 - down),
            (1.0 - across) * down,
            across * down,
        ),
        dim=-1,
    )
    return index, weight
