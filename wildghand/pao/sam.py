"""Segment Anything, for a person who has a checkpoint: regions of a frame, and the hand at a root.

The network is `transformers`' SamModel. A checkpoint is a folder that `transformers` wrote, or a
file of the package `segment-anything`, whose tensors are renamed as the conversion script of
`transformers` does. Its sizes are read from the shapes of its tensors, and it is filled by our own
reader, so that nothing in a file is executed and no file can ask for more memory than it has.
"""

from __future__ import annotations

import functools
import os
import re
from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from torch import Tensor, nn

from hwp_bench.base.arrays import read_tensors
from hwp_bench.base.errors import BadInput
from hwp_bench.base.files import read_json, sha256_json, sha256_of
from hwp_bench.base.packages import import_extra
from wildghand.pao.regions import FrameRegions, overlapping

if TYPE_CHECKING:
    from transformers import SamModel

#: Largest file that is read, bytes; ViT-H has 2.6 GB.
MAX_BYTES = 4 << 30
#: Largest image that a network sees, px; published: 1024.
MAX_EDGE = 2048
#: Most layers of a part; ViT-H has 32.
MAX_LAYERS = 128

_CONFIG = "config.json"
_WEIGHTS = ("model.safetensors", "pytorch_model.bin")
_REMEDY = (
    "Name a folder of `transformers` with a SamModel, or a checkpoint file of `segment-anything`."
)
# Parts of names in files of `segment-anything`, and those that `transformers` has for them, in the
# order in which its script convert_sam_to_hf.py replaces them.
_NAMES = (
    (r"^image_encoder\.", "vision_encoder."),
    (r"\.blocks\.", ".layers."),
    (r"\.patch_embed\.proj\.", ".patch_embed.projection."),
    (r"\.neck\.0\.", ".neck.conv1."),
    (r"\.neck\.1\.", ".neck.layer_norm1."),
    (r"\.neck\.2\.", ".neck.conv2."),
    (r"\.neck\.3\.", ".neck.layer_norm2."),
    (r"\.norm", ".layer_norm"),
    (r"\.pe_layer\.positional_encoding_gaussian_matrix$", ".shared_embedding.positional_embedding"),
    (r"\.point_embeddings\.", ".point_embed."),
    (r"\.mask_downscaling\.0\.", ".mask_embed.conv1."),
    (r"\.mask_downscaling\.1\.", ".mask_embed.layer_norm1."),
    (r"\.mask_downscaling\.3\.", ".mask_embed.conv2."),
    (r"\.mask_downscaling\.4\.", ".mask_embed.layer_norm2."),
    (r"\.mask_downscaling\.6\.", ".mask_embed.conv3."),
    (r"\.output_upscaling\.0\.", ".upscale_conv1."),
    (r"\.output_upscaling\.1\.", ".upscale_layer_norm."),
    (r"\.output_upscaling\.3\.", ".upscale_conv2."),
    (r"(mlps\.\d+|prediction_head)\.layers\.0\.", r"\1.proj_in."),
    (r"(mlps\.\d+|prediction_head)\.layers\.2\.", r"\1.proj_out."),
    (r"(mlps\.\d+|prediction_head)\.layers\.1\.", r"\1.layers.0."),
)
# The waves that stand for places, which prompts and image share, under both of their names.
_WAVES = (
    "prompt_encoder.shared_embedding.positional_embedding",
    "shared_image_embedding.positional_embedding",
)
# Of the images that the networks were trained with, 8-bit levels.
_MEAN, _STD = (123.675, 116.28, 103.53), (58.395, 57.12, 57.375)


# Checkpoints.


def check_checkpoint(path: str | os.PathLike[str]) -> None:
    """Check that a checkpoint holds a Segment Anything network."""
    _load(Path(path))


def load_network(path: str | os.PathLike[str], device: str = "cpu") -> SamModel:
    """Load a network; nothing in its files is executed."""
    model: SamModel = _load(Path(path)).to(device).eval().requires_grad_(False)
    return model


def checkpoint_digest(path: str | os.PathLike[str]) -> str:
    """SHA-256 (hex) of what a checkpoint's network depends on."""
    weights = _weights_file(Path(path))
    config = sha256_of(weights.with_name(_CONFIG)) if Path(path).is_dir() else ""
    return sha256_json(["sam-2", config, sha256_of(weights)])


def _load(path: Path) -> Any:
    """The network, whose tensors stay on the disk until they are used."""
    tensors = read_tensors(_weights_file(path), MAX_BYTES)
    # The package's decoder; `transformers` writes its own numbers.
    decoder: dict[str, Any] = {"num_attention_heads": 8, "layer_norm_eps": 1e-5}
    if path.is_dir():
        decoder = _decoder_of(path / _CONFIG)
    else:
        tensors = {_transformers_name(name): tensor for name, tensor in tensors.items()}
    tensors |= {name: tensors[other] for name in _WAVES for other in _WAVES if other in tensors}
    problem = "transformers is not installed, which runs Segment Anything"
    transformers = import_extra("transformers", "sam", problem)
    try:
        config = transformers.SamConfig(**_sizes(tensors, decoder))
        with torch.device("meta"):
            model = transformers.SamModel(config)
        needed = {name: tensors[name].float() for name in model.state_dict()}
        model.load_state_dict(needed, strict=True, assign=True)
    # A name is missing, a tensor has not the axes or the shape.
    except (KeyError, IndexError, ValueError, RuntimeError) as error:
        lines = [line.strip() for line in str(error).splitlines() if line.strip()]
        raise BadInput(
            f"is not a checkpoint of Segment Anything: {' '.join(lines[-2:])[:200]}",
            where=path,
            remedy=_REMEDY,
        ) from error
    return model


def _transformers_name(name: str) -> str:
    """The name that `transformers` has for a tensor of `segment-anything`."""
    for pattern, replacement in _NAMES:
        name = re.sub(pattern, replacement, name)
    return name


def _weights_file(path: Path) -> Path:
    if not path.exists():
        raise BadInput("does not exist", where=path, remedy=_REMEDY)
    if not path.is_dir():
        return path
    for name in _WEIGHTS:
        if (path / _CONFIG).is_file() and (path / name).is_file():
            return path / name
    raise BadInput(f"lacks {_CONFIG} or {_WEIGHTS[0]}", where=path, remedy=_REMEDY)


def _decoder_of(config: Path) -> dict[str, Any]:
    """Settings of the decoder that shapes do not show; missing ones are those of `transformers`."""
    described = read_json(config)
    if not isinstance(described, dict) or described.get("model_type") != "sam":
        raise BadInput("does not describe a SamModel", where=config, remedy=_REMEDY)
    decoder = described.get("mask_decoder_config")
    found = {"num_attention_heads": 8, "layer_norm_eps": 1e-6}
    for name, most in (("num_attention_heads", 64), ("layer_norm_eps", 1.0)):
        value = decoder.get(name, found[name]) if isinstance(decoder, dict) else found[name]
        if not isinstance(value, type(found[name])) or not 0 < value <= most:
            raise BadInput(f"is {str(value)[:100]!r}", where=config, field=name, remedy=_REMEDY)
        found[name] = value
    return found


def _sizes(tensors: Mapping[str, Tensor], decoder: dict[str, Any]) -> dict[str, Any]:
    """Read the network's configuration from the shapes of its tensors."""
    vision, mask = "vision_encoder.layers", "mask_decoder"

    def shape(name: str) -> tuple[int, ...]:
        return tuple(tensors[name].shape)

    width, _, patch, _ = shape("vision_encoder.patch_embed.projection.weight")
    _, grid, _, _ = shape("vision_encoder.pos_embed")
    reaches: list[int] = []
    while f"{vision}.{len(reaches)}.attn.rel_pos_h" in tensors and len(reaches) < MAX_LAYERS:
        rows, each = shape(f"{vision}.{len(reaches)}.attn.rel_pos_h")
        reaches.append((rows + 1) // 2)
    windows = {reach for reach in reaches if reach != grid}
    if not reaches or len(windows) > 1 or not 0 < grid * patch <= MAX_EDGE or width % each:
        raise ValueError(f"{grid} patches of {patch} px, windows of {sorted(windows)}")
    depth = sum(f"{mask}.transformer.layers.{k}.mlp.lin1.weight" in tensors for k in range(100))
    tokens, channels = shape(f"{mask}.mask_tokens.weight")
    inner, _ = shape(f"{mask}.transformer.final_attn_token_to_image.q_proj.weight")
    if tokens < 2 or not inner or channels % inner or inner % decoder["num_attention_heads"]:
        raise ValueError(f"mask_decoder has {channels} and {inner} channels, {tokens} masks")
    edge = {"image_size": grid * patch, "patch_size": patch}
    return {
        "vision_config": {
            **edge,
            "hidden_size": width,
            "num_hidden_layers": len(reaches),
            "num_attention_heads": width // each,
            "mlp_dim": shape(f"{vision}.0.mlp.lin1.weight")[0],
            "output_channels": channels,
            "num_pos_feats": shape(_WAVES[0])[1],
            "window_size": next(iter(windows), grid),
            "global_attn_indexes": [k for k, reach in enumerate(reaches) if reach == grid],
        },
        "prompt_encoder_config": {
            **edge,
            "hidden_size": channels,
            "mask_input_channels": shape("prompt_encoder.mask_embed.conv3.weight")[1],
        },
        "mask_decoder_config": {
            **decoder,
            "hidden_size": channels,
            "mlp_dim": shape(f"{mask}.transformer.layers.0.mlp.lin1.weight")[0],
            "num_hidden_layers": depth,
            "num_multimask_outputs": tokens - 1,
            "attention_downsample_rate": channels // inner,
            "iou_head_hidden_dim": shape(f"{mask}.iou_prediction_head.proj_in.weight")[0],
        },
    }


# Masks of an image.


def _edge(network: Any) -> int:
    """Edge of the square that a network sees, px."""
    edge: int = network.config.vision_config.image_size
    return edge


@torch.no_grad()
def see_image(network: SamModel, image: np.ndarray) -> SeenImage:
    """Embed an image, (H, W, 3) uint8 sRGB, resized and padded as in the public code."""
    height, width = image.shape[:2]
    edge = _edge(network)
    scale = edge / max(height, width)
    size = max(1, int(height * scale + 0.5)), max(1, int(width * scale + 0.5))
    pixels = torch.from_numpy(np.ascontiguousarray(image)).to(network.device).float()
    resized = nn.functional.interpolate(
        pixels.permute(2, 0, 1)[None], size, mode="bilinear", antialias=True
    ).round()
    mean, std = (resized.new_tensor(values)[:, None, None] for values in (_MEAN, _STD))
    padded = nn.functional.pad((resized - mean) / std, (0, edge - size[1], 0, edge - size[0]))
    return SeenImage(network, network.get_image_embeddings(padded), (height, width), size)


@dataclass(frozen=True, eq=False)
class SeenImage:
    """An image that the network has embedded, ready for prompts."""

    network: SamModel
    #: (1, C, G, G).
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
        scale = places.new_tensor([self.filled[1] / self.size[1], self.filled[0] / self.size[0]])
        points = (places * scale).float().to(self.embedding.device)[None, :, None]
        found = self.network(image_embeddings=self.embedding, input_points=points)
        return found.pred_masks[0], found.iou_scores[0]

    def full(self, masks: Tensor) -> Tensor:
        """Bring coarse logits, (M, 4 G, 4 G), to the image: (M, H, W)."""
        edge = _edge(self.network)
        square = nn.functional.interpolate(
            masks[:, None], (edge, edge), mode="bilinear", align_corners=False
        )
        inside = square[..., : self.filled[0], : self.filled[1]]
        return nn.functional.interpolate(inside, self.size, mode="bilinear", align_corners=False)[
            :, 0
        ]


@dataclass(frozen=True)
class AutomaticSettings:
    """Which automatic masks are kept; the numbers are those of the public code."""

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


#: Which automatic masks are kept by default.
PUBLIC = AutomaticSettings()


def automatic_masks(seen: SeenImage, settings: AutomaticSettings = PUBLIC) -> np.ndarray:
    """The masks of an image, (U, H, W) bool, the best first; there may be none.

    The same image gives the same ones.

    Source: Kirillov et al., "Segment Anything", section 5 and appendix B, without crops.
    """
    line = (torch.arange(settings.points, dtype=torch.float64) + 0.5) / settings.points
    rows, columns = torch.meshgrid(line, line, indexing="ij")
    grid = torch.stack([columns, rows], dim=-1).reshape(-1, 2)
    places = grid * torch.tensor(seen.size[::-1])
    found = [_stable_masks(seen, part, settings) for part in places.split(settings.batch)]
    masks, quality = (torch.cat(parts) for parts in zip(*found, strict=True))
    kept = suppress_overlaps(_boxes(masks), quality, settings.overlap)
    return masks[kept].numpy()


def _stable_masks(
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


def _boxes(masks: Tensor) -> Tensor:
    """(M, 4) first and last column and row, x0 y0 x1 y1, of (M, H, W); zeros without a pixel."""
    boxes = torch.zeros(len(masks), 4)
    for box, mask in zip(boxes, masks, strict=True):
        rows, columns = mask.any(dim=1).nonzero(), mask.any(dim=0).nonzero()
        if len(rows):
            box[:] = torch.stack([columns[0, 0], rows[0, 0], columns[-1, 0], rows[-1, 0]])
    return boxes


def suppress_overlaps(boxes: Tensor, quality: Tensor, overlap: float) -> Tensor:
    """Non-maximum suppression: indices of the boxes that are kept, the best first.

    Args:
        boxes: (M, 4) x0 y0 x1 y1.
        quality: (M,).
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


# As the fit uses it.


class SegmentAnything:
    """Overlapping regions of an image, and the object at a pixel.

    The network is loaded when the first image is cut that no cache has.

    Args:
        identity: digest of the network, where it runs, and its options.
        see: loads the network and embeds images.
        settings: which automatic masks are kept; None: as in the public code.
    """

    def __init__(
        self,
        identity: str,
        see: Callable[[np.ndarray], SeenImage],
        settings: AutomaticSettings | None = None,
    ) -> None:
        self._settings = settings or PUBLIC
        self.identity = sha256_json([identity, asdict(self._settings)])
        self._see = see

    def regions(self, image: np.ndarray) -> FrameRegions:
        """The automatic masks of an (H, W, 3) uint8 sRGB image; there may be none."""
        return overlapping(automatic_masks(self._see(image), self._settings))

    def hand(self, image: np.ndarray, roots: tuple[tuple[float, float], ...]) -> np.ndarray:
        """y_h: the best of three masks at each projected hand root, all hands together.

        Args:
            image: (H, W, 3) uint8 sRGB.
            roots: (x, y) px of each hand, the centre of the top left pixel at 0.5.

        Returns:
            (H, W) bool; roots off the image add nothing.
        """
        height, width = image.shape[:2]
        mask = np.zeros((height, width), dtype=bool)
        inside = [(x, y) for x, y in roots if 0.0 <= x < width and 0.0 <= y < height]
        if not inside:
            return mask
        seen = self._see(image)
        for root in inside:
            coarse, quality = seen.masks_at(torch.tensor([root], dtype=torch.float64))
            best = coarse[0, quality[0].argmax()]
            mask |= (seen.full(best[None])[0] > 0.0).cpu().numpy()
        return mask


@dataclass(frozen=True)
class PromptedHand:
    """The hand of one frame as a segmenter, so that the cache of regions keeps it."""

    #: Finds it.
    sam: SegmentAnything
    #: (x, y) px of each hand's root.
    roots: tuple[tuple[float, float], ...]

    @property
    def identity(self) -> str:
        """Digest of network and prompts; a thousandth of a pixel decides nothing."""
        places = [[str(round(part, 3)) for part in root] for root in self.roots]
        return sha256_json(["hand", self.sam.identity, places])

    def regions(self, image: np.ndarray) -> FrameRegions:
        """The hand as the only region."""
        return overlapping(self.sam.hand(image, self.roots)[None])


def mask_of(regions: FrameRegions) -> np.ndarray:
    """The union of overlapping regions, (H, W) bool."""
    assert regions.membership is not None
    return np.asarray(regions.membership.any(axis=1))[regions.labels]


def open_sam(checkpoint: str | os.PathLike[str], device: str = "cpu") -> SegmentAnything:
    """Open a Segment Anything checkpoint on the user's disk; nothing is downloaded."""
    # A graphics card rounds differently, and a mask may turn on it.
    identity = sha256_json([checkpoint_digest(checkpoint), torch.device(device).type])
    network = functools.cache(lambda: load_network(checkpoint, device))
    return SegmentAnything(identity, lambda image: see_image(network(), image))
