"""Segment Anything as one network, and an image that it has seen."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor, nn

from wildghand.sam.image_encoder import ImageEncoder
from wildghand.sam.mask_decoder import MaskDecoder, PromptEncoder
from wildghand.sam.sizes import DecoderSizes, EncoderSizes

# Of the images that the networks were trained with, 8-bit levels.
_MEAN, _STD = (123.675, 116.28, 103.53), (58.395, 57.12, 57.375)


class SamNetwork(nn.Module):
    """The three parts, named as in the public checkpoints.

    Args:
        encoder: sizes of the image encoder.
        decoder: sizes of the rest.
    """

    def __init__(self, encoder: EncoderSizes, decoder: DecoderSizes) -> None:
        super().__init__()
        #: Edge of the square image that the network sees, px.
        self.edge = encoder.patch * encoder.grid
        self.image_encoder = ImageEncoder(encoder)
        self.prompt_encoder = PromptEncoder(decoder, self.edge, encoder.grid)
        self.mask_decoder = MaskDecoder(decoder)

    @torch.no_grad()
    def see(self, image: np.ndarray) -> SeenImage:
        """Embed an image.

        Args:
            image: (H, W, 3) uint8 sRGB.
        """
        height, width = image.shape[:2]
        scale = self.edge / max(height, width)
        size = max(1, int(height * scale + 0.5)), max(1, int(width * scale + 0.5))
        device = next(self.parameters()).device
        pixels = torch.from_numpy(np.ascontiguousarray(image)).to(device).float()
        resized = nn.functional.interpolate(
            pixels.permute(2, 0, 1)[None], size, mode="bilinear", antialias=True
        ).round()
        mean, std = (resized.new_tensor(values)[:, None, None] for values in (_MEAN, _STD))
        normalised = (resized - mean) / std
        padded = nn.functional.pad(normalised, (0, self.edge - size[1], 0, self.edge - size[0]))
        return SeenImage(self, self.image_encoder(padded)[0], (height, width), size)


@dataclass(frozen=True, eq=False)
class SeenImage:
    """An image that the network has embedded, ready for prompts."""

    #: The network.
    network: SamNetwork
    #: (C, G, G).
    embedding: Tensor
    #: Height and width of the image, px.
    size: tuple[int, int]
    #: Height and width of the part of the network's square that it fills, px.
    filled: tuple[int, int]

    @torch.no_grad()
    def masks_at(self, places: Tensor) -> tuple[Tensor, Tensor]:
        """Three masks for each of P points, coarse.

        Args:
            places: (P, 2) (x, y) px of the image, within half a pixel of the network's square.

        Returns:
            (P, 3, 4 G, 4 G) logits over the network's square, and (P, 3) their predicted IoU.
        """
        prompts, device = self.network.prompt_encoder, self.embedding.device
        scale = places.new_tensor([self.filled[1] / self.size[1], self.filled[0] / self.size[0]])
        tokens = prompts.points((places * scale).float().to(device))
        dense = prompts.no_mask_embed.weight
        return self.network.mask_decoder(self.embedding, prompts.positions(), tokens, dense)

    def full(self, masks: Tensor) -> Tensor:
        """Bring coarse logits, (M, 4 G, 4 G), to the image: (M, H, W)."""
        edge = self.network.edge
        square = nn.functional.interpolate(
            masks[:, None], (edge, edge), mode="bilinear", align_corners=False
        )
        inside = square[..., : self.filled[0], : self.filled[1]]
        return nn.functional.interpolate(inside, self.size, mode="bilinear", align_corners=False)[
            :, 0
        ]
