"""Prompts and the mask decoder of Segment Anything: masks at points, from an image's embedding."""

from __future__ import annotations

import math

import torch
from torch import Tensor, nn

from wildghand.sam.image_encoder import LayerNorm2d
from wildghand.sam.sizes import DecoderSizes
from wildghand.sam.two_way import TwoWayTransformer


class PromptEncoder(nn.Module):
    """Points as tokens, and the positions of the image's embedding.

    Args:
        sizes: of the decoder.
        edge: of the image that the network sees, px.
        grid: edge of its embedding.
    """

    def __init__(self, sizes: DecoderSizes, edge: int, grid: int) -> None:
        super().__init__()
        self.edge, self.grid = edge, grid
        self.pe_layer = _Waves(sizes.width)
        # Labels of points: not the object, the object, and the two corners of a box.
        labels = [nn.Embedding(1, sizes.width) for _ in range(4)]
        self.point_embeddings = nn.ModuleList(labels)
        self.not_a_point_embed = nn.Embedding(1, sizes.width)
        self.no_mask_embed = nn.Embedding(1, sizes.width)

    def points(self, places: Tensor) -> Tensor:
        """Tokens of prompts of one point of the object each, and the one that says "no more".

        Args:
            places: (P, 2) px of the image that the network sees; 0 is the centre of the first
                pixel.

        Returns:
            (P, 2, C).
        """
        label = torch.zeros(1, dtype=torch.int64, device=places.device)
        asked = self.pe_layer((places + 0.5) / self.edge) + self.point_embeddings[1](label)
        nothing = self.not_a_point_embed.weight.expand(len(places), -1)
        return torch.stack([asked, nothing], dim=1)

    def positions(self) -> Tensor:
        """(C, G, G) positions of the embedding's cells."""
        device = self.no_mask_embed.weight.device
        centres = (torch.arange(self.grid, device=device) + 0.5) / self.grid
        rows, columns = torch.meshgrid(centres, centres, indexing="ij")
        return self.pe_layer(torch.stack([columns, rows], dim=-1)).permute(2, 0, 1)


class _Waves(nn.Module):
    """Places in [0, 1], (..., 2), as random waves, (..., C)."""

    positional_encoding_gaussian_matrix: Tensor

    def __init__(self, width: int) -> None:
        super().__init__()
        self.register_buffer("positional_encoding_gaussian_matrix", torch.zeros(2, width // 2))

    def forward(self, places: Tensor) -> Tensor:
        turns = (2.0 * places - 1.0) @ self.positional_encoding_gaussian_matrix
        angles = 2.0 * math.pi * turns
        return torch.cat([angles.sin(), angles.cos()], dim=-1)


class MaskDecoder(nn.Module):
    """Three masks and their qualities for each prompt.

    Args:
        sizes: of its layers.

    Source: Kirillov et al., "Segment Anything", appendix A.
    """

    def __init__(self, sizes: DecoderSizes) -> None:
        super().__init__()
        width = sizes.width
        self.transformer = TwoWayTransformer(sizes)
        self.iou_token = nn.Embedding(1, width)
        # The first mask is the one for unambiguous prompts.
        self.mask_tokens = nn.Embedding(sizes.masks, width)
        self.output_upscaling = nn.Sequential(
            nn.ConvTranspose2d(width, width // 4, 2, stride=2),
            LayerNorm2d(width // 4),
            nn.GELU(),
            nn.ConvTranspose2d(width // 4, width // 8, 2, stride=2),
            nn.GELU(),
        )
        self.output_hypernetworks_mlps = nn.ModuleList(
            _Layers(width, width, width // 8) for _ in range(sizes.masks)
        )
        self.iou_prediction_head = _Layers(width, sizes.quality_hidden, sizes.masks)

    def forward(
        self, embedding: Tensor, positions: Tensor, prompts: Tensor, dense: Tensor
    ) -> tuple[Tensor, Tensor]:
        """Masks of P prompts in one image.

        Args:
            embedding: (C, G, G) of the image.
            positions: (C, G, G) of its cells.
            prompts: (P, T, C) tokens.
            dense: (1, C), what stands for "no mask was given".

        Returns:
            (P, 3, 4 G, 4 G) logits, and (P, 3) predicted IoU with the true mask.
        """
        count, grid = len(prompts), embedding.shape[-1]
        own = torch.cat([self.iou_token.weight, self.mask_tokens.weight])
        tokens = torch.cat([own.expand(count, -1, -1), prompts], dim=1)
        cells = (embedding + dense.reshape(-1, 1, 1)).flatten(1).T.expand(count, -1, -1)
        tokens, cells = self.transformer(cells, positions.flatten(1).T, tokens)
        image = cells.transpose(1, 2).reshape(count, -1, grid, grid)
        fine = self.output_upscaling(image)
        filters = torch.stack(
            [made(tokens[:, 1 + k]) for k, made in enumerate(self.output_hypernetworks_mlps)], dim=1
        )
        masks = torch.einsum("pkc,pchw->pkhw", filters, fine)
        return masks[:, 1:], self.iou_prediction_head(tokens[:, 0])[:, 1:]


class _Layers(nn.Module):
    """Three linear layers with ReLU between them."""

    def __init__(self, inputs: int, hidden: int, outputs: int) -> None:
        super().__init__()
        self.layers = nn.ModuleList(
            [nn.Linear(inputs, hidden), nn.Linear(hidden, hidden), nn.Linear(hidden, outputs)]
        )

    def forward(self, values: Tensor) -> Tensor:
        """(..., inputs) to (..., outputs)."""
        first, second, third = self.layers
        return third(second(first(values).relu()).relu())
