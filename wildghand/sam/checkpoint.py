"""Checkpoints of Segment Anything: read without trust, from either of the two public formats."""

from __future__ import annotations

import os
import re
from collections.abc import Mapping
from pathlib import Path

import torch
from torch import Tensor

from hwp_bench.base.arrays import read_tensors
from hwp_bench.base.errors import BadInput, HwpError
from hwp_bench.base.files import read_json, sha256_json, sha256_of
from wildghand.sam.network import SamNetwork
from wildghand.sam.sizes import DECODER_HEADS, decoder_sizes, encoder_sizes

#: Largest file that is read, bytes; ViT-H has 2.6 GB.
MAX_BYTES = 4 << 30
#: Largest image that a network sees, px, and most patches along its edge; published: 1024 and 64.
MAX_EDGE, MAX_GRID = 2048, 128

_CONFIG = "config.json"
_WEIGHTS = ("model.safetensors", "pytorch_model.bin")
_REMEDY = (
    "Name a folder of `transformers` with a SamModel, or a checkpoint file of `segment-anything`."
)
# Names in a folder of `transformers`, and those of `segment-anything`, in the order in which they
# are replaced.
_NAMES = (
    (r"^shared_image_embedding\.positional_embedding$", "pe"),
    (r"^pe$", "prompt_encoder.pe_layer.positional_encoding_gaussian_matrix"),
    (r"^vision_encoder\.", "image_encoder."),
    (r"patch_embed\.projection\.", "patch_embed.proj."),
    (r"^image_encoder\.layers\.(\d+)\.layer_norm", r"image_encoder.blocks.\1.norm"),
    (r"^image_encoder\.layers\.", "image_encoder.blocks."),
    (r"neck\.conv1\.", "neck.0."),
    (r"neck\.layer_norm1\.", "neck.1."),
    (r"neck\.conv2\.", "neck.2."),
    (r"neck\.layer_norm2\.", "neck.3."),
    (r"prompt_encoder\.point_embed\.", "prompt_encoder.point_embeddings."),
    (r"layer_norm_final_attn\.", "norm_final_attn."),
    (r"(transformer\.layers\.\d+)\.layer_norm", r"\1.norm"),
    (r"mask_decoder\.upscale_conv1\.", "mask_decoder.output_upscaling.0."),
    (r"mask_decoder\.upscale_layer_norm\.", "mask_decoder.output_upscaling.1."),
    (r"mask_decoder\.upscale_conv2\.", "mask_decoder.output_upscaling.3."),
    (r"(mlps\.\d+|prediction_head)\.layers\.0\.", r"\1.layers.1."),
    (r"(mlps\.\d+|prediction_head)\.proj_in\.", r"\1.layers.0."),
    (r"(mlps\.\d+|prediction_head)\.proj_out\.", r"\1.layers.2."),
)


def check_checkpoint(path: str | os.PathLike[str]) -> None:
    """Check that a checkpoint holds a Segment Anything network.

    Raises:
        BadInput: it is missing, unreadable, or a tensor is missing or of another shape.
    """
    _fitting(Path(path))


def load_network(path: str | os.PathLike[str], device: str = "cpu") -> SamNetwork:
    """Load a network; nothing in its files is executed.

    Args:
        path: a folder in the layout of `transformers` (config.json and weights), or a checkpoint
            file of the package `segment-anything`. Neither package is needed.
        device: torch device.

    Raises:
        BadInput: it is missing, unreadable, or a tensor is missing or of another shape.
    """
    network, tensors = _fitting(Path(path))
    network.load_state_dict(tensors, strict=True, assign=True)
    return network.to(device).eval().requires_grad_(False)


def checkpoint_digest(path: str | os.PathLike[str]) -> str:
    """SHA-256 (hex) of what a checkpoint's network depends on.

    Raises:
        BadInput: it is missing.
    """
    weights = _weights_file(Path(path))
    config = sha256_of(weights.with_name(_CONFIG)) if Path(path).is_dir() else ""
    return sha256_json(["sam-1", config, sha256_of(weights)])


def _fitting(path: Path) -> tuple[SamNetwork, dict[str, Tensor]]:
    """A network without memory, and the tensors that fit it."""
    tensors, heads = read_tensors(_weights_file(path), MAX_BYTES), DECODER_HEADS
    if path.is_dir():
        heads = _heads_of(path / _CONFIG)
        tensors = {_former_name(name): value for name, value in tensors.items()}
    try:
        encoder, decoder = encoder_sizes(tensors), decoder_sizes(tensors, heads)
        if encoder.grid > MAX_GRID or encoder.grid * encoder.patch > MAX_EDGE:
            raise BadInput(f"has {encoder.grid} patches of {encoder.patch} px", field="pos_embed")
        with torch.device("meta"):
            network = SamNetwork(encoder, decoder)
        return network, _of_shapes(network, tensors)
    except HwpError as error:
        raise BadInput(
            f"is not a checkpoint of Segment Anything: {error.field or 'a tensor'} {error.problem}",
            where=path,
            remedy=_REMEDY,
        ) from error


def _of_shapes(network: SamNetwork, tensors: Mapping[str, Tensor]) -> dict[str, Tensor]:
    """The tensors that the network needs, in float32."""
    found = {}
    for name, needed in network.state_dict().items():
        tensor = tensors.get(name)
        if tensor is None or tensor.shape != needed.shape or not tensor.is_floating_point():
            shape = None if tensor is None else tuple(tensor.shape)
            raise BadInput(f"has the shape {shape}, not {tuple(needed.shape)}", field=name)
        found[name] = tensor.float()
    return found


def _weights_file(path: Path) -> Path:
    if not path.exists():
        raise BadInput("does not exist", where=path, remedy=_REMEDY)
    if not path.is_dir():
        return path
    for name in _WEIGHTS:
        if (path / _CONFIG).is_file() and (path / name).is_file():
            return path / name
    raise BadInput(f"lacks {_CONFIG} or {_WEIGHTS[0]}", where=path, remedy=_REMEDY)


def _heads_of(config: Path) -> int:
    """The heads of the decoder, the only size that no tensor's shape tells."""
    described = read_json(config)
    if not isinstance(described, dict) or described.get("model_type") != "sam":
        raise BadInput("does not describe a SamModel", where=config, remedy=_REMEDY)
    decoder = described.get("mask_decoder_config")
    heads = decoder.get("num_attention_heads", DECODER_HEADS) if isinstance(decoder, dict) else 8
    if not isinstance(heads, int) or not 1 <= heads <= 64:
        raise BadInput("is not a number of heads", where=config, field="num_attention_heads")
    return heads


def _former_name(name: str) -> str:
    for pattern, replacement in _NAMES:
        name = re.sub(pattern, replacement, name)
    if re.fullmatch(r"prompt_encoder\.(not_a_point_embed|no_mask_embed)", name):
        name += ".weight"
    return name
