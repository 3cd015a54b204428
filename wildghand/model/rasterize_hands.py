"""The Gaussians of several hands in one picture."""

from __future__ import annotations

import torch
from torch import Tensor

from wildghand.model.dress import Gaussians
from wildghand.splat import rasterize


def rasterize_hands(
    parts: list[Gaussians], viewmats: Tensor, Ks: Tensor, width: int, height: int
) -> tuple[Tensor, Tensor]:
    """Draw the Gaussians of hands together in B frames.

    Args:
        parts: of each hand.
        viewmats: (B, 4, 4).
        Ks: (B, 3, 3) px.
        width, height: px.

    Returns:
        (B, H, W, 3) sRGB over black and (B, H, W, 1) coverage.
    """

    def joined(name: str, shared: int) -> Tensor:
        tensors = [getattr(part, name) for part in parts]
        if len(tensors) == 1:
            return tensors[0]
        if any(tensor.dim() > shared for tensor in tensors):
            tensors = [
                tensor if tensor.dim() > shared else tensor.expand(len(viewmats), *tensor.shape)
                for tensor in tensors
            ]
        return torch.cat(tensors, dim=tensors[0].dim() - shared)

    image, coverage, _ = rasterize(
        joined("means", 2),
        joined("quats", 2),
        joined("scales", 2),
        joined("opacities", 1),
        joined("colors", 2),
        viewmats,
        Ks,
        width,
        height,
    )
    return image, coverage
