"""Checkpoints of exactly the public formats with random weights: tiny Segment Anything, VGG-19.

Names and shapes are written out here, from the public checkpoints, not taken from our networks.
"""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import torch
from safetensors.torch import save_file

#: Edge of the image that the tiny network sees, of its patches and of their grid.
EDGE, PATCH, GRID = 64, 8, 8
# Channels of patches and of tokens, heads of the encoder, edge of its windows.
_WIDTH, _OUT, _HEADS, _WINDOW = 16, 16, 2, 3
# Channels and kernel edge of VGG-19's convolutions, by place in `features`.
_VGG = {0: 64, 2: 64, 5: 128, 7: 128, 10: 256, 12: 256, 14: 256, 16: 256,
        19: 512, 21: 512, 23: 512, 25: 512, 28: 512, 30: 512, 32: 512, 34: 512}  # fmt: skip


def _linear(name: str, inputs: int, outputs: int) -> dict[str, tuple[int, ...]]:
    return {f"{name}.weight": (outputs, inputs), f"{name}.bias": (outputs,)}


def _norm(name: str, channels: int) -> dict[str, tuple[int, ...]]:
    return {f"{name}.weight": (channels,), f"{name}.bias": (channels,)}


def _attention(name: str, inner: int) -> dict[str, tuple[int, ...]]:
    shapes: dict[str, tuple[int, ...]] = {}
    for part in ("q", "k", "v"):
        shapes |= _linear(f"{name}.{part}_proj", _OUT, inner)
    return shapes | _linear(f"{name}.out_proj", inner, _OUT)


def sam_shapes() -> dict[str, tuple[int, ...]]:
    """Names and shapes of the tiny network, as the package `segment-anything` saves it."""
    w, c = _WIDTH, _OUT
    shapes: dict[str, tuple[int, ...]] = {
        "image_encoder.pos_embed": (1, GRID, GRID, w),
        "image_encoder.patch_embed.proj.weight": (w, 3, PATCH, PATCH),
        "image_encoder.patch_embed.proj.bias": (w,),
    }
    for layer, reach in enumerate((_WINDOW, GRID)):
        block = f"image_encoder.blocks.{layer}"
        shapes |= _norm(f"{block}.norm1", w) | _norm(f"{block}.norm2", w)
        shapes |= _linear(f"{block}.attn.qkv", w, 3 * w) | _linear(f"{block}.attn.proj", w, w)
        shapes |= {f"{block}.attn.rel_pos_{axis}": (2 * reach - 1, w // _HEADS) for axis in "hw"}
        shapes |= _linear(f"{block}.mlp.lin1", w, 4 * w) | _linear(f"{block}.mlp.lin2", 4 * w, w)
    shapes |= {"image_encoder.neck.0.weight": (c, w, 1, 1)} | _norm("image_encoder.neck.1", c)
    shapes |= {"image_encoder.neck.2.weight": (c, c, 3, 3)} | _norm("image_encoder.neck.3", c)
    prompt = "prompt_encoder"
    shapes |= {f"{prompt}.pe_layer.positional_encoding_gaussian_matrix": (2, c // 2)}
    names = [*(f"point_embeddings.{k}" for k in range(4)), "not_a_point_embed", "no_mask_embed"]
    shapes |= {f"{prompt}.{name}.weight": (1, c) for name in names}
    for place, (inputs, outputs, edge) in {0: (1, 4, 2), 3: (4, 16, 2), 6: (16, c, 1)}.items():
        mask = f"{prompt}.mask_downscaling.{place}"
        shapes |= {f"{mask}.weight": (outputs, inputs, edge, edge), f"{mask}.bias": (outputs,)}
        if place < 6:
            shapes |= _norm(f"{prompt}.mask_downscaling.{place + 1}", outputs)
    decoder = "mask_decoder"
    for layer in range(2):
        block = f"{decoder}.transformer.layers.{layer}"
        shapes |= _attention(f"{block}.self_attn", c)
        for cross in ("token_to_image", "image_to_token"):
            shapes |= _attention(f"{block}.cross_attn_{cross}", c // 2)
        for number in range(1, 5):
            shapes |= _norm(f"{block}.norm{number}", c)
        shapes |= _linear(f"{block}.mlp.lin1", c, 32) | _linear(f"{block}.mlp.lin2", 32, c)
    shapes |= _attention(f"{decoder}.transformer.final_attn_token_to_image", c // 2)
    shapes |= _norm(f"{decoder}.transformer.norm_final_attn", c)
    shapes |= {f"{decoder}.iou_token.weight": (1, c), f"{decoder}.mask_tokens.weight": (4, c)}
    for place, inputs, outputs in ((0, c, c // 4), (3, c // 4, c // 8)):
        up = f"{decoder}.output_upscaling.{place}"
        shapes |= {f"{up}.weight": (inputs, outputs, 2, 2), f"{up}.bias": (outputs,)}
    shapes |= _norm(f"{decoder}.output_upscaling.1", c // 4)
    heads = {f"{decoder}.output_hypernetworks_mlps.{k}": (c, c // 8) for k in range(4)}
    for name, (hidden, outputs) in {**heads, f"{decoder}.iou_prediction_head": (16, 4)}.items():
        shapes |= _linear(f"{name}.layers.0", c, hidden)
        shapes |= _linear(f"{name}.layers.1", hidden, hidden)
        shapes |= _linear(f"{name}.layers.2", hidden, outputs)
    return shapes


def sam_tensors(seed: int = 0) -> dict[str, torch.Tensor]:
    """Random weights, the same on every machine; every mask is predicted to be a good one."""
    random, tensors = np.random.default_rng(seed), {}
    for name, shape in sorted(sam_shapes().items()):
        values = random.normal(0.0, 1.0, shape)
        if "norm" in name or ".neck.1" in name or ".neck.3" in name or "upscaling.1" in name:
            values = 0.1 * values + float(name.endswith("weight"))
        elif values.ndim > 1 and "gaussian" not in name:
            values *= 2.5 / np.sqrt(max(1.0, values[0].size))
        tensors[name] = torch.from_numpy(values.astype(np.float32))
    tensors["mask_decoder.iou_prediction_head.layers.2.bias"] += 4.0
    for mask in range(4):  # sure of every pixel, so that masks are stable
        tensors[f"mask_decoder.output_hypernetworks_mlps.{mask}.layers.2.weight"] *= 10.0
    return tensors


def write_sam_file(path: Path, seed: int = 0) -> Path:
    """Write a checkpoint as the package `segment-anything` does."""
    torch.save(sam_tensors(seed), path)
    return path


def write_sam_folder(folder: Path, seed: int = 0) -> Path:
    """Write the same network as `transformers` saves a SamModel."""
    folder.mkdir(parents=True)
    tensors = {transformers_name(name): value for name, value in sam_tensors(seed).items()}
    shared = tensors["shared_image_embedding.positional_embedding"]
    tensors["prompt_encoder.shared_embedding.positional_embedding"] = shared.clone()
    save_file(tensors, folder / "model.safetensors", metadata={"format": "pt"})
    config = {
        "architectures": ["SamModel"],
        "model_type": "sam",
        "vision_config": {
            "model_type": "sam_vision_model", "hidden_size": _WIDTH, "num_hidden_layers": 2,
            "num_attention_heads": _HEADS, "image_size": EDGE, "patch_size": PATCH,
            "output_channels": _OUT, "mlp_dim": 4 * _WIDTH, "num_pos_feats": _OUT // 2,
            "window_size": _WINDOW, "global_attn_indexes": [1],
        },
        "prompt_encoder_config": {
            "hidden_size": _OUT, "image_size": EDGE, "patch_size": PATCH,
            "image_embedding_size": GRID, "num_point_embeddings": 4, "mask_input_channels": 16,
        },
        "mask_decoder_config": {
            "hidden_size": _OUT, "mlp_dim": 32, "num_attention_heads": 8, "num_hidden_layers": 2,
            "iou_head_hidden_dim": 16, "attention_downsample_rate": 2, "layer_norm_eps": 1e-5,
        },
    }  # fmt: skip
    (folder / "config.json").write_text(json.dumps(config))
    return folder


def transformers_name(name: str) -> str:
    """The name that `transformers` has for a tensor of `segment-anything`."""
    parts = name.split(".")
    if name.endswith("gaussian_matrix"):
        return "shared_image_embedding.positional_embedding"
    if parts[0] == "image_encoder":
        if parts[1] == "neck":
            parts[2] = ("conv1", "layer_norm1", "conv2", "layer_norm2")[int(parts[2])]
        renamed = {"image_encoder": "vision_encoder", "blocks": "layers", "norm1": "layer_norm1",
                   "norm2": "layer_norm2", "proj": "projection"}  # fmt: skip
        if "attn" in parts:
            del renamed["proj"]
        return ".".join(renamed.get(part, part) for part in parts)
    if parts[0] == "prompt_encoder":
        if parts[1] == "mask_downscaling":
            kinds = ("conv1", "layer_norm1", "", "conv2", "layer_norm2", "", "conv3")
            return f"prompt_encoder.mask_embed.{kinds[int(parts[2])]}.{parts[3]}"
        if parts[1] == "point_embeddings":
            return f"prompt_encoder.point_embed.{parts[2]}.weight"
        return name
    if parts[1] == "output_upscaling":
        kind = {"0": "upscale_conv1", "1": "upscale_layer_norm", "3": "upscale_conv2"}[parts[2]]
        return f"mask_decoder.{kind}.{parts[3]}"
    if "layers" in parts and parts[1] != "transformer":
        place = parts.index("layers")
        kind = ("proj_in", "layers.0", "proj_out")[int(parts[place + 1])]
        return ".".join([*parts[:place], kind, *parts[place + 2 :]])
    if parts[1] == "transformer":
        renamed = {f"norm{k}": f"layer_norm{k}" for k in range(1, 5)}
        renamed["norm_final_attn"] = "layer_norm_final_attn"
        return ".".join(renamed.get(part, part) for part in parts)
    return name


def write_vgg19(path: Path) -> Path:
    """Write torchvision's VGG-19 without its classifier, of which nothing is needed."""
    random, before, tensors = np.random.default_rng(0), 3, {}
    for place, channels in _VGG.items():
        spread = np.sqrt(2.0 / (9 * before))
        weight = random.standard_normal((channels, before, 3, 3), dtype=np.float32) * spread
        tensors[f"features.{place}.weight"] = torch.from_numpy(weight.astype(np.float32))
        tensors[f"features.{place}.bias"] = torch.zeros(channels)
        before = channels
    if path.suffix == ".safetensors":
        save_file(tensors, path)
    else:
        torch.save(tensors, path)
    return path
