"""The texture before its fit: weighted medians of what training frames show of each place."""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor
from torch.nn.functional import grid_sample, max_pool2d

from hwp_bench.base.numerics import kd_tree
from wildghand.evidence.count import seen_anchors
from wildghand.gaussians.rig import AnchorPoses

#: Most frames that are unwrapped; of longer clips as many, evenly spread.
MOST_FRAMES = 256


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


@torch.no_grad()
def unwrap(
    sides: list[str],
    posed: Callable[[Tensor], dict[str, tuple[AnchorPoses, Tensor]]],
    cameras: Callable[[Tensor], tuple[Tensor, Tensor]],
    pictures: Callable[[Tensor], tuple[Tensor, Tensor]],
    count: int,
) -> dict[str, tuple[Tensor, Tensor]]:
    """Divide frames by their shadows, and take the median at each anchor.

    Args:
        sides: the hands.
        posed: takes rows, (B,) int64, and returns the anchors of each hand and their shadows,
            (B, N).
        cameras: takes rows, and returns viewmats (B, 4, 4) and Ks (B, 3, 3).
        pictures: takes rows, and returns images (B, H, W, 3) sRGB and masks (B, H, W) in [0, 1].
        count: R.

    Returns:
        By side: (N, 3) sRGB in full light, and (N,) the weight of the frames that show it, 0 where
        none does.
    """
    values: dict[str, list[Tensor]] = {side: [] for side in sides}
    weights: dict[str, list[Tensor]] = {side: [] for side in sides}
    chosen = torch.linspace(0, count - 1, min(count, MOST_FRAMES)).round().long()
    for rows in chosen.split(16):
        hands = posed(rows)
        viewmats, Ks = cameras(rows)
        images, masks = pictures(rows)
        # A border's pixel is partly background, and it is where a wrong pose shows first.
        inner = -max_pool2d(-masks[:, None], 3, 1, 1)[:, 0]
        places = seen_anchors(
            {side: anchors for side, (anchors, _) in hands.items()}, viewmats, Ks, masks.shape[1:]
        )
        for side, (_, shadows) in hands.items():
            pixels, facing = places[side]
            inside = read_pixels(inner[..., None], pixels)[..., 0]
            weights[side].append(facing.square() * (inside > 0.99))
            values[side].append(read_pixels(images, pixels) / shadows[..., None].clamp(min=0.05))
    found = {}
    for side in sides:
        weight = torch.cat(weights[side])
        found[side] = weighted_median(torch.cat(values[side]), weight), weight.sum(dim=0)
    return found


def nearest_anchor(uv: Tensor, size: int) -> Tensor:
    """The anchor whose texture coordinates are nearest to each texel's centre: (size^2,) int64."""
    place = (torch.arange(size) + 0.5) / size
    rows, columns = torch.meshgrid(1.0 - place, place, indexing="ij")
    texels = torch.stack((columns.flatten(), rows.flatten()), dim=-1)
    _, index = kd_tree(uv.double().cpu().numpy()).query(texels.double().numpy())
    return torch.from_numpy(index)
