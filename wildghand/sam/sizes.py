"""Sizes of a Segment Anything network, as the shapes of its tensors tell them."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

from torch import Tensor

from hwp_bench.base.errors import BadInput

#: Heads of the decoder's attention in all published networks; no tensor's shape tells it.
DECODER_HEADS = 8
# Largest number in any size: ViT-H has 5,120 hidden units.
_MOST = 16_384
# Most layers: ViT-H has 32.
_MOST_LAYERS = 128


@dataclass(frozen=True)
class EncoderSizes:
    """Of the image encoder."""

    #: Edge of a patch, px.
    patch: int
    #: Patches along an edge of the image.
    grid: int
    #: Channels of a patch.
    width: int
    #: Attention heads.
    heads: int
    #: Hidden units of a layer.
    hidden: int
    #: Channels of the embedding.
    out: int
    #: Edge of the windows of each layer, in patches; `grid` where a layer sees everything.
    reaches: tuple[int, ...]


@dataclass(frozen=True)
class DecoderSizes:
    """Of the prompt encoder and the mask decoder."""

    #: Channels of tokens and of the embedding.
    width: int
    #: Channels of attention between tokens and image.
    inner: int
    #: Hidden units of a layer.
    hidden: int
    #: Layers.
    depth: int
    #: Attention heads.
    heads: int
    #: Masks of a prompt, that for unambiguous ones included.
    masks: int
    #: Hidden units of the predictor of a mask's quality.
    quality_hidden: int


def encoder_sizes(tensors: Mapping[str, Tensor]) -> EncoderSizes:
    """Read the sizes of the image encoder.

    Args:
        tensors: by the names of the package `segment-anything`.

    Raises:
        BadInput: a tensor is missing, or its shape makes no sense.
    """
    width, _, patch, _ = _shape(tensors, "image_encoder.patch_embed.proj.weight", 4)
    _, grid, _, _ = _shape(tensors, "image_encoder.pos_embed", 4)
    hidden, _ = _shape(tensors, "image_encoder.blocks.0.mlp.lin1.weight", 2)
    out = _shape(tensors, "image_encoder.neck.0.weight", 4)[0]
    layers = _count(tensors, "image_encoder.blocks.{}.attn.rel_pos_h")
    reaches, heads = [], 1
    for layer in range(layers):
        rows, each = _shape(tensors, f"image_encoder.blocks.{layer}.attn.rel_pos_h", 2)
        if rows % 2 == 0 or each > width or width % each:
            raise BadInput(f"has the shape ({rows}, {each})", field=f"blocks.{layer}.rel_pos_h")
        reaches.append((rows + 1) // 2)
        heads = width // each
    return EncoderSizes(patch, grid, width, heads, hidden, out, tuple(reaches))


def decoder_sizes(tensors: Mapping[str, Tensor], heads: int = DECODER_HEADS) -> DecoderSizes:
    """Read the sizes of the decoder.

    Args:
        tensors: by the names of the package `segment-anything`.
        heads: of its attention.

    Raises:
        BadInput: a tensor is missing, or its shape makes no sense.
    """
    masks, width = _shape(tensors, "mask_decoder.mask_tokens.weight", 2)
    final = "mask_decoder.transformer.final_attn_token_to_image.q_proj.weight"
    inner = _shape(tensors, final, 2)[0]
    hidden = _shape(tensors, "mask_decoder.transformer.layers.0.mlp.lin1.weight", 2)[0]
    depth = _count(tensors, "mask_decoder.transformer.layers.{}.norm1.weight")
    quality = _shape(tensors, "mask_decoder.iou_prediction_head.layers.0.weight", 2)[0]
    if width % 8 or inner % heads or width % heads or masks < 2:
        raise BadInput(f"has {width} and {inner} channels, {masks} masks", field="mask_decoder")
    return DecoderSizes(width, inner, hidden, depth, heads, masks, quality)


def _shape(tensors: Mapping[str, Tensor], name: str, dimensions: int) -> tuple[int, ...]:
    found = tensors.get(name)
    if found is None:
        raise BadInput("is missing", field=name)
    shape = tuple(found.shape)
    if len(shape) != dimensions or not all(1 <= size <= _MOST for size in shape):
        raise BadInput(f"has the shape {shape}", field=name)
    return shape


def _count(tensors: Mapping[str, Tensor], name: str) -> int:
    count = next((k for k in range(_MOST_LAYERS + 1) if name.format(k) not in tensors), 0)
    if not count:
        raise BadInput("has no layer, or too many", field=name.format("N"))
    return count
