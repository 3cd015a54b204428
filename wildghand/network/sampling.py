"""Reading a UV plane at fixed points, and gathering points in its cells."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor, nn
from torch.nn.functional import embedding_bag

from hwp_bench.base.errors import UsageError
from wildghand.gaussians.bags import sum_bags
from wildghand.splat.threads import kernels_take


class FixedGather(nn.Module):
    """Weighted sums of rows, of which index and weight never change: a sparse matrix.

    The matrix is kept by rows and by columns, so that the gradient is gathered too. Nothing is
    ever scattered; the result is the same bit for bit every time, on a GPU as well.

    Args:
        rows: (K,) int64 in [0, outputs), which sum each term belongs to.
        columns: (K,) int64 in [0, inputs), which row it takes.
        weights: (K,) of the terms.
        outputs: number of sums.
        inputs: number of rows to take from.
    """

    index: Tensor
    weight: Tensor
    start: Tensor
    back_index: Tensor
    back_weight: Tensor
    back_start: Tensor

    def __init__(
        self, rows: Tensor, columns: Tensor, weights: Tensor, outputs: int, inputs: int
    ) -> None:
        super().__init__()
        for prefix, to, source, count in (
            ("", rows, columns, outputs),
            ("back_", columns, rows, inputs),
        ):
            order = torch.argsort(to, stable=True)
            bags = torch.arange(count, dtype=to.dtype, device=to.device)
            tables = {
                "index": source[order],
                "weight": weights[order],
                "start": torch.searchsorted(to[order], bags),
            }
            for name, tensor in tables.items():
                self.register_buffer(prefix + name, tensor.contiguous(), persistent=False)

    def transposed(self, values: Tensor) -> Tensor:
        """(outputs, C) to (inputs, C): what each row gave is added up there; no gradient."""
        return _sum_bags(values, self.back_index, self.back_weight, self.back_start)

    def forward(self, values: Tensor) -> Tensor:
        """(inputs, C) to (outputs, C)."""
        return _Gather.apply(
            values,
            self.index,
            self.weight,
            self.start,
            self.back_index,
            self.back_weight,
            self.back_start,
        )


class _Gather(torch.autograd.Function):
    """A sum over bags of rows; its transpose is another one."""

    @staticmethod
    def forward(ctx: Any, values: Tensor, *tables: Tensor) -> Tensor:
        ctx.save_for_backward(*tables[3:])
        return _sum_bags(values, *tables[:3])

    @staticmethod
    def backward(ctx: Any, *grads: Tensor) -> tuple[Tensor | None, ...]:
        return (_sum_bags(grads[0], *ctx.saved_tensors), *(None,) * 6)


def _sum_bags(values: Tensor, index: Tensor, weight: Tensor, start: Tensor) -> Tensor:
    on_cpu = all(tensor.device.type == "cpu" for tensor in (index, start))
    if on_cpu and kernels_take(values, weight):
        return sum_bags(values, index, weight, start)
    return embedding_bag(
        index,
        values.contiguous(),
        start,
        mode="sum",
        per_sample_weights=weight.to(values.dtype),
    )


class PlaneSampler(FixedGather):
    """Bilinear reading of a square plane at N fixed points: (resolution^2, C) to (N, C).

    The plane's rows go from its top left texel, row by row.

    Args:
        uv: (N, 2) in [0, 1], origin at the bottom left.
        resolution: texels along each edge; their centres lie at (k + 0.5) / resolution, and
            points beyond the outermost centres read the border.

    Raises:
        UsageError: `resolution` is below 1.
    """

    def __init__(self, uv: Tensor, resolution: int) -> None:
        if resolution < 1:
            raise UsageError(f"is {resolution}", field="resolution", remedy="Use 1 or more.")
        index, weight = bilinear_taps(uv, resolution)
        rows = torch.arange(len(uv), device=uv.device).repeat_interleave(index.shape[1])
        super().__init__(rows, index.flatten(), weight.flatten(), len(uv), resolution**2)


class CellPooling(FixedGather):
    """Means over the points of each cell of a square plane: (N, C) to (resolution^2, C).

    A cell without a point holds 0.

    Args:
        uv: (N, 2) in [0, 1], origin at the bottom left.
        resolution: cells along each edge.
    """

    cell: Tensor

    def __init__(self, uv: Tensor, resolution: int) -> None:
        column = (uv[:, 0] * resolution).long().clamp(0, resolution - 1)
        row = ((1.0 - uv[:, 1]) * resolution).long().clamp(0, resolution - 1)
        cell = row * resolution + column
        members = torch.bincount(cell, minlength=resolution**2)
        points = torch.arange(len(uv), device=uv.device)
        super().__init__(cell, points, 1.0 / members[cell].to(uv.dtype), resolution**2, len(uv))
        #: (N,) the cell of each point.
        self.register_buffer("cell", cell, persistent=False)


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
