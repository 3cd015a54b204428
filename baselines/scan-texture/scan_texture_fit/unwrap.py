"""The texture before its fit: weighted medians of what training frames show of each place."""

from __future__ import annotations

import torch
from torch import Tensor
from torch.nn.functional import grid_sample

from hwp_bench.base.numerics import kd_tree


def weighted_median(values: Tensor, weights: Tensor) -> Tensor:
    """The smallest value that at least half of the weight does not exceed.

    Args:
        values: (R, N, C).
        weights: (R, N), not negative.

    Returns:
        (N, C); 0 where all weights are 0.
    """
    order = values.argsort(dim=0)
    ranked = values.gather(0, order)
    share = weights[..., None].expand_as(values).gather(0, order).cumsum(dim=0)
    total = share[-1:]
    first = (share >= 0.5 * total).to(torch.int8).argmax(dim=0, keepdim=True)
    found = ranked.gather(0, first)[0]
    return torch.where(total[0] > 0.0, found, torch.zeros_like(found))


def read_pixels(images: Tensor, pixels: Tensor) -> Tensor:
    """Bilinear values of images (B, H, W, C) at places (B, N, 2) px: (B, N, C)."""
    height, width = images.shape[1:3]
    size = pixels.new_tensor((width, height))
    grid = (2.0 * pixels / size - 1.0)[:, None]
    found = grid_sample(images.movedim(-1, 1), grid, align_corners=False, padding_mode="border")
    return found[:, :, 0].mT


def nearest_anchor(uv: Tensor, size: int) -> Tensor:
    """The anchor whose texture coordinates are nearest to each texel's centre: (size^2,) int64."""
    place = (torch.arange(size) + 0.5) / size
    rows, columns = torch.meshgrid(1.0 - place, place, indexing="ij")
    texels = torch.stack((columns.flatten(), rows.flatten()), dim=-1)
    _, index = kd_tree(uv.double().cpu().numpy()).query(texels.double().numpy())
    return torch.from_numpy(index)
