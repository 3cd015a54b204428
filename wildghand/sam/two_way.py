"""The transformer of Segment Anything's decoder: tokens and image attend to each other."""

from __future__ import annotations

from torch import Tensor, nn

from wildghand.sam.sizes import DecoderSizes


class TwoWayTransformer(nn.Module):
    """Tokens that read an image, and an image that reads the tokens.

    Args:
        sizes: of its layers.
    """

    def __init__(self, sizes: DecoderSizes) -> None:
        super().__init__()
        self.layers = nn.ModuleList(_Layer(sizes, first=k == 0) for k in range(sizes.depth))
        self.final_attn_token_to_image = _Attention(sizes, sizes.inner)
        self.norm_final_attn = nn.LayerNorm(sizes.width)

    def forward(self, cells: Tensor, positions: Tensor, prompts: Tensor) -> tuple[Tensor, Tensor]:
        """Exchange what tokens and image know.

        Args:
            cells: (P, G², C) the image's embedding.
            positions: (G², C) of its cells.
            prompts: (P, T, C) tokens.

        Returns:
            tokens (P, T, C) and cells (P, G², C).
        """
        tokens = prompts
        for layer in self.layers:
            tokens, cells = layer(tokens, cells, prompts, positions)
        read = self.final_attn_token_to_image(tokens + prompts, cells + positions, cells)
        return self.norm_final_attn(tokens + read), cells


class _Layer(nn.Module):
    def __init__(self, sizes: DecoderSizes, *, first: bool) -> None:
        super().__init__()
        self.first = first
        self.self_attn = _Attention(sizes, sizes.width)
        self.norm1 = nn.LayerNorm(sizes.width)
        self.cross_attn_token_to_image = _Attention(sizes, sizes.inner)
        self.norm2 = nn.LayerNorm(sizes.width)
        inward, outward = nn.Linear(sizes.width, sizes.hidden), nn.Linear(sizes.hidden, sizes.width)
        self.mlp = nn.ModuleDict({"lin1": inward, "lin2": outward})
        self.norm3 = nn.LayerNorm(sizes.width)
        self.norm4 = nn.LayerNorm(sizes.width)
        self.cross_attn_image_to_token = _Attention(sizes, sizes.inner)

    def forward(
        self, tokens: Tensor, cells: Tensor, prompts: Tensor, positions: Tensor
    ) -> tuple[Tensor, Tensor]:
        if self.first:  # the tokens are the prompts themselves
            tokens = self.self_attn(tokens, tokens, tokens)
        else:
            placed = tokens + prompts
            tokens = tokens + self.self_attn(placed, placed, tokens)
        tokens = self.norm1(tokens)
        read = self.cross_attn_token_to_image(tokens + prompts, cells + positions, cells)
        tokens = self.norm2(tokens + read)
        tokens = self.norm3(tokens + self.mlp["lin2"](self.mlp["lin1"](tokens).relu()))
        read = self.cross_attn_image_to_token(cells + positions, tokens + prompts, tokens)
        return tokens, self.norm4(cells + read)


class _Attention(nn.Module):
    def __init__(self, sizes: DecoderSizes, inner: int) -> None:
        super().__init__()
        self.heads = sizes.heads
        self.q_proj = nn.Linear(sizes.width, inner)
        self.k_proj = nn.Linear(sizes.width, inner)
        self.v_proj = nn.Linear(sizes.width, inner)
        self.out_proj = nn.Linear(inner, sizes.width)

    def forward(self, queries: Tensor, keys: Tensor, values: Tensor) -> Tensor:
        parts = (self.q_proj(queries), self.k_proj(keys), self.v_proj(values))
        split = [part.unflatten(-1, (self.heads, -1)).transpose(-2, -3) for part in parts]
        read = nn.functional.scaled_dot_product_attention(*split)
        return self.out_proj(read.transpose(-2, -3).flatten(-2))
