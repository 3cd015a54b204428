"""LPIPS in plain torch: two backbones, no torchvision (Zhang et al., CVPR 2018, version 0.1)."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from hwp_bench.base.errors import BadInput, ShapeMismatch
from hwp_bench.metrics.pixels import check_same_shape

if TYPE_CHECKING:
    import torch

#: Mean and standard deviation of the images in [-1, 1] that LPIPS was calibrated with.
SHIFT = (-0.030, -0.088, -0.188)
SCALE = (0.458, 0.448, 0.450)
#: Keeps the unit normalisation of a feature vector of zeros finite.
EPSILON = 1e-10


@dataclass(frozen=True)
class Convolution:
    """One convolution with its ReLU, as the torchvision checkpoint numbers it."""

    #: Place in `features`: its weights are `features.{index}.weight` and `.bias`.
    index: int
    #: Input and output channels.
    channels: tuple[int, int]
    #: Side of the kernel, px.
    kernel: int
    stride: int
    padding: int
    #: (kernel, stride) of the max pooling before it, if there is one.
    pool: tuple[int, int] | None = None
    #: True where LPIPS compares the features after its ReLU.
    tap: bool = False


def _vgg_block(first: int, channels: tuple[int, int], count: int) -> tuple[Convolution, ...]:
    """`count` 3x3 convolutions; the first changes the channels, the last is compared."""
    return tuple(
        Convolution(
            index=first + 2 * k,
            channels=channels if k == 0 else (channels[1], channels[1]),
            kernel=3,
            stride=1,
            padding=1,
            pool=(2, 2) if k == 0 and first > 0 else None,
            tap=k == count - 1,
        )
        for k in range(count)
    )


#: The convolutional parts of AlexNet (one-column form) and VGG-16.
BACKBONES: Mapping[str, tuple[Convolution, ...]] = {
    "alex": (
        Convolution(0, (3, 64), 11, 4, 2, tap=True),
        Convolution(3, (64, 192), 5, 1, 2, pool=(3, 2), tap=True),
        Convolution(6, (192, 384), 3, 1, 1, pool=(3, 2), tap=True),
        Convolution(8, (384, 256), 3, 1, 1, tap=True),
        Convolution(10, (256, 256), 3, 1, 1, tap=True),
    ),
    "vgg": (
        *_vgg_block(0, (3, 64), 2),
        *_vgg_block(5, (64, 128), 2),
        *_vgg_block(10, (128, 256), 3),
        *_vgg_block(17, (256, 512), 3),
        *_vgg_block(24, (512, 512), 3),
    ),
}


class Lpips:
    """The distance with its weights.

    Args:
        net: "alex" or "vgg".
        backbone: state of the torchvision classifier; only its `features.*` are used.
        linear: state of the LPIPS linear layers, `lin{0..4}.model.1.weight` (1, C, 1, 1).
        device: where it runs.

    Raises:
        BadInput: a weight is missing, of another shape, or not finite.
    """

    def __init__(
        self,
        net: str,
        backbone: Mapping[str, torch.Tensor],
        linear: Mapping[str, torch.Tensor],
        device: str = "cpu",
    ) -> None:
        self.net = net
        self.device = device
        self._layers = BACKBONES[net]
        self._weights: list[tuple[torch.Tensor, torch.Tensor]] = []
        for layer in self._layers:
            fan_in, fan_out = layer.channels
            name = f"features.{layer.index}"
            shape = (fan_out, fan_in, layer.kernel, layer.kernel)
            weight = _checked(backbone, f"{name}.weight", shape)
            bias = _checked(backbone, f"{name}.bias", (fan_out,))
            self._weights.append((weight.to(device), bias.to(device)))
        taps = [layer.channels[1] for layer in self._layers if layer.tap]
        self._linear = [
            _checked(linear, f"lin{k}.model.1.weight", (1, channels, 1, 1)).to(device)
            for k, channels in enumerate(taps)
        ]

    def __call__(self, prediction: np.ndarray, target: np.ndarray) -> float:
        """LPIPS of two (H, W, 3) float images in [0, 1], sRGB; 0 for identical images.

        Raises:
            ShapeMismatch: shapes differ, or are too small for the backbone.
        """
        import torch

        check_same_shape(prediction, target)
        pair = torch.from_numpy(np.stack([prediction, target])).to(self.device, torch.float32)
        pair = pair.permute(0, 3, 1, 2) * 2.0 - 1.0
        with torch.inference_mode():
            return float(self.distance(pair[:1], pair[1:])[0])

    def distance(self, x: torch.Tensor, y: torch.Tensor) -> torch.Tensor:
        """LPIPS of image batches.

        Args:
            x: (B, 3, H, W) float in [-1, 1], on the device of the weights.
            y: like `x`.

        Returns:
            (B,): over the compared layers, the sum of the spatial means of the weighted squared
            differences of unit feature vectors.

        Raises:
            ShapeMismatch: shapes differ, or are too small for the backbone.
        """
        if x.shape != y.shape or x.ndim != 4 or x.shape[1] != 3:
            raise ShapeMismatch(f"LPIPS wants two (B, 3, H, W), not {x.shape} and {y.shape}")
        if min(x.shape[2:]) < 32:
            raise ShapeMismatch(f"images of {tuple(x.shape[2:])} are too small for LPIPS")
        total = x.new_zeros(x.shape[0])
        features = zip(self._features(x), self._features(y), self._linear, strict=True)
        for a, b, weight in features:
            squared = (_unit(a) - _unit(b)) ** 2
            total = total + (squared * weight).sum(dim=1).mean(dim=(1, 2))
        return total

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


def _checked(state: Mapping[str, torch.Tensor], name: str, shape: tuple[int, ...]) -> torch.Tensor:
    """The float32 tensor `name` of `state`, if it has that shape and finite values."""
    import torch

    tensor = state.get(name)
    if not isinstance(tensor, torch.Tensor):
        raise BadInput("the checkpoint lacks this weight", field=name)
    if tuple(tensor.shape) != shape:
        raise BadInput(f"has shape {tuple(tensor.shape)}, not {shape}", field=name)
    if not bool(torch.isfinite(tensor).all()):
        raise BadInput("holds NaN or infinite values", field=name)
    return tensor.detach().to(torch.float32)
