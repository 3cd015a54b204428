"""The fixed side of one hand's surface: where its Gaussians lie, and samplers of every plane."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn
from torch.nn.functional import embedding_bag

from hwp_bench.base.errors import UsageError
from hwp_bench.hands import HandTemplate, SurfaceAnchors, anchor_uv
from wildghand.network.settings import NetworkSettings

#: Frequencies of a rest position: 3 coordinates x 3 frequencies x 2 = the authors' 18 numbers.
POSITION_FREQUENCIES = 3
#: Length of `encode_positions`.
POSITION_CHANNELS = 3 * 2 * POSITION_FREQUENCIES


def positional_encoding(values: Tensor, frequencies: int) -> Tensor:
    """(..., 2 D frequencies): all sines of 2^k pi x, then all cosines, k below `frequencies`.

    Source: Mildenhall et al., "NeRF", equation 4.
    """
    scales = 2.0 ** torch.arange(frequencies, dtype=values.dtype, device=values.device)
    angles = (math.pi * values[..., None] * scales).flatten(-2)
    return torch.cat((angles.sin(), angles.cos()), dim=-1)


def encode_positions(positions: Tensor) -> Tensor:
    """Encode (N, 3) rest positions in [-1, 1] as (N, 18); unlike uv they know no seams."""
    # Half of the range, so that the lowest frequency tells the two ends of the hand apart.
    return positional_encoding(0.5 * positions, POSITION_FREQUENCIES)


def encode_pose(pose: Tensor, frequencies: int) -> Tensor:
    """Embed (B, 16, 3) rad as (B, 96 frequencies); 8 make the paper's 768 numbers."""
    # A rotation vector is at most pi long: a quarter turn of the lowest sine is half of that.
    return positional_encoding(pose.flatten(1) / (2.0 * math.pi), frequencies)


class FixedGather(nn.Module):
    """Weighted sums of rows, of which index and weight never change: a sparse matrix.

    Term k adds row columns[k] times weights[k] to sum rows[k]. The matrix is kept by rows and by
    columns, so that the gradient is gathered too. Nothing is ever scattered; the result is the same
    bit for bit every time, on a GPU as well.
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
    weights = weight.to(values.dtype)
    return embedding_bag(index, values.contiguous(), start, mode="sum", per_sample_weights=weights)


class PlaneSampler(FixedGather):
    """Bilinear reading of a square plane at N fixed points: (resolution^2, C) to (N, C).

    The plane's rows go from its top left texel, row by row; texels' centres lie at (k + 0.5) /
    resolution. (N, 2) uv in [0, 1] have their origin at the bottom left; points beyond the
    outermost centres read the border.
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
    """The four texels around each of (N, 2) uv: (N, 4) int64 row-major, and their weights."""
    x = (uv[:, 0] * resolution - 0.5).clamp(0.0, resolution - 1.0)
    y = ((1.0 - uv[:, 1]) * resolution - 0.5).clamp(0.0, resolution - 1.0)
    left, top = x.floor().long(), y.floor().long()
    columns = torch.stack((left, (left + 1).clamp(max=resolution - 1)), dim=-1)
    rows = torch.stack((top, (top + 1).clamp(max=resolution - 1)), dim=-1)
    across = torch.stack((1.0 - (x - left), x - left), dim=-1)
    down = torch.stack((1.0 - (y - top), y - top), dim=-1)
    index = (rows[:, :, None] * resolution + columns[:, None]).flatten(1)
    weight = (across[:, None] * down[:, :, None]).flatten(1)
    return index, weight


#: Channels of `Chart.coordinates`: uv and the encoded rest position.
COORDINATES = 2 + POSITION_CHANNELS


@dataclass(frozen=True, eq=False)
class SurfacePoints:
    """N anchors of one hand at rest."""

    #: (N, 2) texture coordinates in [0, 1], origin at the bottom left.
    uv: Tensor
    #: (N, 3) rest positions, each axis in [-1, 1]; a left hand's are those of its mirror image.
    positions: Tensor
    #: Mean distance between neighbouring anchors, m.
    spacing: float
    #: (3,) sRGB in [0, 1] that the fit starts from: the mean colour of the hand.
    color: Tensor

    def __len__(self) -> int:
        return len(self.uv)


def surface_points(
    template: HandTemplate, anchors: SurfaceAnchors, spacing: float, color: Tensor
) -> SurfacePoints:
    """Describe the anchors of a hand, `spacing` m apart, to the network: float32 on the CPU."""
    faces = np.asarray(torch.as_tensor(anchors.face_index).cpu())
    mix = np.asarray(torch.as_tensor(anchors.barycentric).cpu(), dtype=np.float64)
    corners = template.vertices[template.faces[faces]]
    positions = (corners * mix[..., None]).sum(axis=1)
    low, high = template.vertices.min(axis=0), template.vertices.max(axis=0)
    positions = (2.0 * positions - low - high) / (high - low)
    if template.side == "left":
        positions[:, 0] *= -1.0
    uv = anchor_uv(template, SurfaceAnchors(faces, mix))
    return SurfacePoints(
        uv=torch.as_tensor(uv, dtype=torch.float32),
        positions=torch.as_tensor(positions, dtype=torch.float32),
        spacing=spacing,
        color=color.detach().float().cpu(),
    )


def mirrored_anchors(anchors: SurfaceAnchors) -> SurfaceAnchors:
    """The same points of the skin on the mirrored hand.

    `mirror_template` keeps the order of the faces and turns each round (last corner first), so
    the barycentric coordinates turn round with them. Anchors that are sampled on the mirrored
    template instead share the faces but lie elsewhere in them.
    """
    mix = anchors.barycentric
    turned = mix.flip(-1) if isinstance(mix, Tensor) else mix[:, ::-1].copy()
    return SurfaceAnchors(anchors.face_index, turned)


def plane_resolutions(settings: NetworkSettings) -> tuple[int, ...]:
    """Edges of the planes that features are read from, in cells."""
    if settings.size == "compact":
        return (settings.plane_resolution,)
    return tuple(settings.plane_resolution * factor for factor in (2, 4, 8, 16))


class Chart(nn.Module):
    """Everything about N anchors that does not change. Nothing here is learned or saved."""

    coordinates: Tensor

    def __init__(self, settings: NetworkSettings, surface: SurfacePoints) -> None:
        super().__init__()
        coordinates = torch.cat(
            (2.0 * surface.uv - 1.0, encode_positions(surface.positions)), dim=-1
        )
        self.register_buffer("coordinates", coordinates, persistent=False)
        self.identity = PlaneSampler(surface.uv, settings.identity_resolution)
        self.planes = nn.ModuleList(
            PlaneSampler(surface.uv, resolution) for resolution in plane_resolutions(settings)
        )
        self.cells = CellPooling(surface.uv, settings.plane_resolution)
        cell_coordinates = self.cells(coordinates)
        self.register_buffer("cell_coordinates", cell_coordinates, persistent=False)

    cell_coordinates: Tensor

    def __len__(self) -> int:
        return len(self.coordinates)
