"""The image encoder of Segment Anything: a vision transformer with windows."""

from __future__ import annotations

import torch
from torch import Tensor, nn

from wildghand.sam.sizes import EncoderSizes


class LayerNorm2d(nn.Module):
    """Layer norm over the channels of (B, C, H, W)."""

    def __init__(self, channels: int) -> None:
        super().__init__()
        self.weight = nn.Parameter(torch.ones(channels))
        self.bias = nn.Parameter(torch.zeros(channels))

    def forward(self, images: Tensor) -> Tensor:
        """Normalise, (B, C, H, W)."""
        centred = images - images.mean(dim=1, keepdim=True)
        scaled = centred / (centred.square().mean(dim=1, keepdim=True) + 1e-6).sqrt()
        return self.weight[:, None, None] * scaled + self.bias[:, None, None]


class ImageEncoder(nn.Module):
    """From an image to its embedding.

    Names of parameters are those of the public checkpoints.

    Args:
        sizes: of its layers.

    Source: Kirillov et al., "Segment Anything", section 3; Li et al., "Exploring plain vision
    transformer backbones for object detection" (windows, relative positions).
    """

    def __init__(self, sizes: EncoderSizes) -> None:
        super().__init__()
        width, out = sizes.width, sizes.out
        proj = nn.Conv2d(3, width, sizes.patch, stride=sizes.patch)
        self.patch_embed = nn.ModuleDict({"proj": proj})
        self.pos_embed = nn.Parameter(torch.zeros(1, sizes.grid, sizes.grid, width))
        self.blocks = nn.ModuleList(_Block(sizes, reach) for reach in sizes.reaches)
        self.neck = nn.Sequential(
            nn.Conv2d(width, out, 1, bias=False),
            LayerNorm2d(out),
            nn.Conv2d(out, out, 3, padding=1, bias=False),
            LayerNorm2d(out),
        )

    def forward(self, images: Tensor) -> Tensor:
        """Encode (B, 3, S, S) normalised images: (B, C, S / patch, S / patch)."""
        patches = self.patch_embed["proj"](images).permute(0, 2, 3, 1) + self.pos_embed
        for block in self.blocks:
            patches = block(patches)
        return self.neck(patches.permute(0, 3, 1, 2))


class _Block(nn.Module):
    """Attention within windows of an edge, or in the whole grid where that is as large."""

    def __init__(self, sizes: EncoderSizes, reach: int) -> None:
        super().__init__()
        self.reach = reach
        self.norm1 = nn.LayerNorm(sizes.width, eps=1e-6)
        self.attn = _Attention(sizes, reach)
        self.norm2 = nn.LayerNorm(sizes.width, eps=1e-6)
        first, second = nn.Linear(sizes.width, sizes.hidden), nn.Linear(sizes.hidden, sizes.width)
        self.mlp = nn.ModuleDict({"lin1": first, "lin2": second})

    def forward(self, patches: Tensor) -> Tensor:
        """(B, H, W, C) to (B, H, W, C)."""
        batch, high, wide, channels = patches.shape
        reach = self.reach
        right, below = -wide % reach, -high % reach
        # Windows that reach beyond the image see zeros there.
        padded = nn.functional.pad(self.norm1(patches), (0, 0, 0, right, 0, below))
        rows, columns = padded.shape[1] // reach, padded.shape[2] // reach
        windows = padded.reshape(batch, rows, reach, columns, reach, channels)
        windows = windows.transpose(2, 3).reshape(-1, reach, reach, channels)
        seen = self.attn(windows).reshape(batch, rows, columns, reach, reach, channels)
        seen = seen.transpose(2, 3).reshape(padded.shape)[:, :high, :wide]
        patches = patches + seen
        hidden = nn.functional.gelu(self.mlp["lin1"](self.norm2(patches)))
        return patches + self.mlp["lin2"](hidden)


class _Attention(nn.Module):
    """Attention with a bias that depends on the difference of rows and of columns."""

    def __init__(self, sizes: EncoderSizes, reach: int) -> None:
        super().__init__()
        self.heads = sizes.heads
        self.qkv = nn.Linear(sizes.width, 3 * sizes.width)
        self.proj = nn.Linear(sizes.width, sizes.width)
        each = sizes.width // sizes.heads
        self.rel_pos_h = nn.Parameter(torch.zeros(2 * reach - 1, each))
        self.rel_pos_w = nn.Parameter(torch.zeros(2 * reach - 1, each))

    def forward(self, windows: Tensor) -> Tensor:
        """(B, R, R, C) to (B, R, R, C)."""
        batch, reach, _, channels = windows.shape
        mixed = self.qkv(windows).reshape(batch, reach * reach, 3, self.heads, -1)
        queries, keys, values = mixed.permute(2, 0, 3, 1, 4)
        places = torch.arange(reach, device=windows.device)
        apart = places[:, None] - places[None, :] + reach - 1
        square = queries.reshape(batch, self.heads, reach, reach, -1)
        of_rows = torch.einsum("bnhwc,hkc->bnhwk", square, self.rel_pos_h[apart])
        of_columns = torch.einsum("bnhwc,wkc->bnhwk", square, self.rel_pos_w[apart])
        bias = of_rows[..., :, None] + of_columns[..., None, :]
        bias = bias.reshape(batch, self.heads, reach * reach, reach * reach)
        seen = nn.functional.scaled_dot_product_attention(queries, keys, values, attn_mask=bias)
        return self.proj(seen.transpose(1, 2).reshape(batch, reach, reach, channels))
