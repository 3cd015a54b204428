"""Distances that not everybody can compute: LPIPS with its weights, FLIP with its package.

LPIPS is in plain torch (Zhang et al., CVPR 2018, version 0.1). FLIP (Andersson et al., HPG 2020) is
that of NVIDIA's package flip-evaluator.

Nothing is downloaded. The backbone is the torchvision checkpoint in the torch hub cache; the
linear layers come from the `lpips` package, or torchmetrics, which ships the same bytes. A file
that is not byte for byte the published one is refused: the number would not be LPIPS.
"""

from __future__ import annotations

import hashlib
import importlib.util
import os
import pickle
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from hwp_bench.base.errors import BadInput, MissingDependency

if TYPE_CHECKING:
    import torch

    from hwp_bench.metrics.score import Network


#: Mean and standard deviation of the images in [-1, 1] that LPIPS was calibrated with.
SHIFT = (-0.030, -0.088, -0.188)
SCALE = (0.458, 0.448, 0.450)
#: Keeps the unit normalisation of a feature vector of zeros finite.
EPSILON = 1e-10


class Convolution(NamedTuple):
    """One convolution with its ReLU, as the torchvision checkpoint numbers it."""

    #: Number in `features`: its weights are `features.{number}.weight` and `.bias`.
    number: int
    stride: int
    padding: int
    #: (kernel, stride) of the max pooling before it, if there is one.
    pool: tuple[int, int] | None
    #: True where LPIPS compares the features after its ReLU.
    tap: bool


#: The convolutional parts of AlexNet (one-column form) and VGG-16.
BACKBONES: Mapping[str, tuple[Convolution, ...]] = {
    "alex": (
        Convolution(0, 4, 2, None, True),
        Convolution(3, 1, 2, (3, 2), True),
        Convolution(6, 1, 1, (3, 2), True),
        Convolution(8, 1, 1, None, True),
        Convolution(10, 1, 1, None, True),
    ),
    # Five blocks; each but the first is pooled before its first convolution.
    "vgg": tuple(
        Convolution(k, 1, 1, (2, 2) if k in (5, 10, 17, 24) else None, k in (2, 7, 14, 21, 28))
        for k in (0, 2, 5, 7, 10, 12, 14, 17, 19, 21, 24, 26, 28)
    ),
}


class Lpips:
    """The distance with its weights.

    `backbone` is the state of the torchvision classifier, of which only `features.*` are used;
    `linear` that of the linear layers, `lin{0..4}.model.1.weight` (1, C, 1, 1).
    """

    def __init__(
        self,
        net: str,
        backbone: Mapping[str, torch.Tensor],
        linear: Mapping[str, torch.Tensor],
    ) -> None:
        self._layers = BACKBONES[net]
        names = [f"features.{layer.number}" for layer in self._layers]
        self._weights = [
            (backbone[f"{name}.weight"].float(), backbone[f"{name}.bias"].float()) for name in names
        ]
        taps = sum(layer.tap for layer in self._layers)
        self._linear = [linear[f"lin{k}.model.1.weight"].float() for k in range(taps)]

    def __call__(self, prediction: np.ndarray, target: np.ndarray) -> float:
        """LPIPS of two (H, W, 3) float images in [0, 1], sRGB; 0 for identical images.

        Over the compared layers, the sum of the spatial means of the weighted squared differences
        of unit feature vectors.
        """
        import torch

        pair = torch.from_numpy(np.stack([prediction, target])).to(torch.float32)
        pair = pair.permute(0, 3, 1, 2) * 2.0 - 1.0
        with torch.inference_mode():
            total = pair.new_zeros(1)
            features = zip(
                self._features(pair[:1]), self._features(pair[1:]), self._linear, strict=True
            )
            for a, b, weight in features:
                squared = (_unit(a) - _unit(b)) ** 2
                total = total + (squared * weight).sum(dim=1).mean(dim=(1, 2))
            return float(total[0])

    def _features(self, image: torch.Tensor) -> list[torch.Tensor]:
        """The compared feature maps of (B, 3, H, W) in [-1, 1]."""
        from torch.nn import functional as F

        shift = image.new_tensor(SHIFT)[:, None, None]
        scale = image.new_tensor(SCALE)[:, None, None]
        current = (image - shift) / scale
        taps = []
        for layer, (weight, bias) in zip(self._layers, self._weights, strict=True):
            if layer.pool is not None:
                current = F.max_pool2d(current, *layer.pool)
            current = F.conv2d(current, weight, bias, layer.stride, layer.padding).relu()
            if layer.tap:
                taps.append(current)
        return taps


def _unit(features: torch.Tensor) -> torch.Tensor:
    """Feature vectors (B, C, H, W) brought to length 1 along C."""
    length = features.square().sum(dim=1, keepdim=True).sqrt()
    return features / (length + EPSILON)


#: File names of the torchvision checkpoints, newest first; the hexadecimal part of the name is
#: the start of the file's SHA-256.
BACKBONE_FILES: Mapping[str, tuple[str, ...]] = {
    "alex": ("alexnet-owt-7be5be79.pth", "alexnet-owt-4df8aa71.pth"),
    "vgg": ("vgg16-397923af.pth",),
}
#: SHA-256 of the linear layers, version 0.1.
LINEAR_DIGESTS: Mapping[str, str] = {
    "alex": "df73285e35b22355a2df87cdb6b70b343713b667eddbda73e1977e0c860835c0",
    "vgg": "a78928a0af1e5f0fcb1f3b9e8f8c3a2a5a3de244d830ad5c1feddc79b8432868",
}
#: Packages that contain the linear layers, and the folder inside them.
LINEAR_PACKAGES = (
    ("lpips", "weights/v0.1"),
    ("torchmetrics", "functional/image/lpips_models"),
)


def lpips_available(net: str) -> str | None:
    """Why LPIPS with this backbone cannot be computed here; None if it can.

    Looks for the files only (no torch import, no reading): a damaged file shows in `load_lpips`.
    """
    try:
        _find_backbone(net)
        _find_linear(net)
    except MissingDependency as error:
        return str(error)
    return None


def load_lpips(net: str) -> Lpips:
    """LPIPS with the weights found on this machine."""
    backbone, linear = _find_backbone(net), _find_linear(net)
    prefixes = [Path(name).stem.rsplit("-", 1)[1] for name in BACKBONE_FILES[net]]
    return Lpips(net, _read_state(backbone, prefixes), _read_state(linear, [LINEAR_DIGESTS[net]]))


def load_available() -> dict[str, Network]:
    """LPIPS by backbone where its weights are there, and FLIP where it is installed."""
    found: dict[str, Network] = {}
    found |= {net: load_lpips(net) for net in BACKBONE_FILES if lpips_available(net) is None}
    if importlib.util.find_spec("flip_evaluator") is not None:
        found["flip"] = flip_map
    return found


def flip_map(prediction: np.ndarray, target: np.ndarray) -> np.ndarray:
    """LDR-FLIP of two (H, W, 3) float images in [0, 1], sRGB: (H, W) in [0, 1], 0 where alike.

    Viewed as the package assumes: 67 pixels a degree, 0.7 m before a display of 3840 px and 0.7 m.
    """
    from flip_evaluator import evaluate

    pair = (np.ascontiguousarray(image, np.float32) for image in (target, prediction))
    distances, _, _ = evaluate(*pair, "LDR", applyMagma=False, computeMeanError=False)
    return np.asarray(distances)[..., 0]


def torch_home() -> Path:
    """The folder of torch's downloaded weights, found without importing torch."""
    cache = os.environ.get("XDG_CACHE_HOME", "~/.cache")
    return Path(os.environ.get("TORCH_HOME") or f"{cache}/torch").expanduser()


def _find_backbone(net: str) -> Path:
    candidates = [torch_home() / "hub" / "checkpoints" / name for name in BACKBONE_FILES[net]]
    for path in candidates:
        if path.is_file():
            return path
    raise MissingDependency(
        f"the backbone weights of LPIPS ({net}) are not there",
        where=candidates[0],
        remedy=f"Put the torchvision checkpoint {BACKBONE_FILES[net][0]} there.",
    )


def _find_linear(net: str) -> Path:
    for package, folder in LINEAR_PACKAGES:
        spec = importlib.util.find_spec(package)
        for root in (spec.submodule_search_locations or []) if spec else []:
            path = Path(root) / folder / f"{net}.pth"
            if path.is_file():
                return path
    raise MissingDependency(
        f"the linear layers of LPIPS ({net}) are not there",
        remedy="Install the package lpips (without its dependencies is enough).",
    )


def _read_state(path: Path, digests: list[str]) -> dict[str, Any]:
    """A checkpoint of plain tensors whose SHA-256 starts with one of `digests`."""
    import torch

    with path.open("rb") as file:
        digest = hashlib.file_digest(file, "sha256").hexdigest()
    if not digest.startswith(tuple(digests)):
        raise BadInput(
            f"is not the published checkpoint (SHA-256 {digest[:16]}...)",
            where=path,
            remedy=f"The file's SHA-256 must start with {' or '.join(d[:16] for d in digests)}.",
        )
    try:
        state = torch.load(path, map_location="cpu", weights_only=True)
    except (OSError, EOFError, RuntimeError, ValueError, pickle.UnpicklingError) as error:
        raise BadInput(
            f"cannot be read as a checkpoint of tensors ({type(error).__name__})", where=path
        ) from error
    if not isinstance(state, dict):
        raise BadInput("holds no dictionary of tensors", where=path)
    return state
