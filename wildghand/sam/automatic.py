"""Automatic masks of Segment Anything: everything that a grid of points prompts."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from wildghand.sam.network import SamNetwork, SeenImage


@dataclass(frozen=True)
class AutomaticSettings:
    """Which masks are kept; the numbers are those of the public code."""

    #: Points along an edge of the image.
    points: int = 32
    #: Points that are prompted at once.
    batch: int = 64
    #: Masks of a predicted IoU not above it are dropped.
    quality: float = 0.88
    #: Masks are dropped whose extent at the two thresholds +-`offset` has a smaller IoU.
    stability: float = 0.95
    #: Logit by which the threshold is moved to measure stability.
    offset: float = 1.0
    #: Of two masks whose boxes have a larger IoU, the one of lower quality is dropped.
    overlap: float = 0.7


def automatic_masks(
    network: SamNetwork, image: np.ndarray, settings: AutomaticSettings = AutomaticSettings()
) -> np.ndarray:
    """The masks of an image; the same image gives the same ones.

    Args:
        network: with its weights.
        image: (H, W, 3) uint8 sRGB.
        settings: which are kept.

    Returns:
        (U, H, W) bool, the best first; there may be none.

    Source: Kirillov et al., "Segment Anything", section 5 and appendix B, without crops.
    """
    seen = network.see(image)
    places = _grid(settings.points) * torch.tensor(image.shape[1::-1])
    found = [_masks_of(seen, part, settings) for part in places.split(settings.batch)]
    masks, quality = (torch.cat(parts) for parts in zip(*found, strict=True))
    kept = distinct(_boxes(masks), quality, settings.overlap)
    return masks[kept].numpy()


def _masks_of(
    seen: SeenImage, places: Tensor, settings: AutomaticSettings
) -> tuple[Tensor, Tensor]:
    """The sure and stable masks of some points, (M, H, W) bool, and their qualities; on the CPU."""
    coarse, quality = (found.flatten(0, 1) for found in seen.masks_at(places))
    sure = quality > settings.quality
    logits, quality = seen.full(coarse[sure]), quality[sure]
    inner = (logits > settings.offset).flatten(1).sum(dim=1)
    outer = (logits > -settings.offset).flatten(1).sum(dim=1)
    stable = inner >= settings.stability * outer.clamp(min=1)
    return (logits[stable] > 0.0).cpu(), quality[stable].cpu()


def _grid(points: int) -> Tensor:
    """(points², 2) places (x, y) in [0, 1], row by row."""
    line = (torch.arange(points, dtype=torch.float64) + 0.5) / points
    rows, columns = torch.meshgrid(line, line, indexing="ij")
    return torch.stack([columns, rows], dim=-1).reshape(-1, 2)


def _boxes(masks: Tensor) -> Tensor:
    """(M, 4) first and last column and row, x0 y0 x1 y1, of (M, H, W); zeros without a pixel."""
    boxes = torch.zeros(len(masks), 4)
    for box, mask in zip(boxes, masks, strict=True):
        rows, columns = mask.any(dim=1).nonzero(), mask.any(dim=0).nonzero()
        if len(rows):
            box[:] = torch.stack([columns[0, 0], rows[0, 0], columns[-1, 0], rows[-1, 0]])
    return boxes


def distinct(boxes: Tensor, quality: Tensor, overlap: float) -> Tensor:
    """Non-maximum suppression.

    Args:
        boxes: (M, 4) x0 y0 x1 y1.
        quality: (M,).
        overlap: largest IoU of two boxes that are both kept.

    Returns:
        indices of those that are kept, the best first.
    """
    area = (boxes[:, 2:] - boxes[:, :2]).prod(dim=1)
    waiting = quality.argsort(descending=True, stable=True)
    kept = []
    while len(waiting):
        best, others = waiting[0], waiting[1:]
        kept.append(int(best))
        low = torch.maximum(boxes[best, :2], boxes[others, :2])
        high = torch.minimum(boxes[best, 2:], boxes[others, 2:])
        shared = (high - low).clamp(min=0.0).prod(dim=1)
        whole = area[best] + area[others] - shared
        waiting = others[~(shared > overlap * whole)]
    return torch.tensor(kept, dtype=torch.int64)
