"""Perceptual distances of W I and W I_hat: a bank of fixed filters, or VGG-19 from a file."""

from __future__ import annotations

import os
from pathlib import Path

import torch
from torch import Tensor, nn

from hwp_bench.base.arrays import read_tensors
from hwp_bench.base.colors import LUMA
from hwp_bench.base.errors import BadInput, ShapeMismatch

#: Octaves of the filter bank.
SCALES = 4
# Edges below this are not halved any more.
_LEAST_EDGE = 8
# Convolutions of VGG-19 up to relu5_1 by place in torchvision's `features`: output channels.
_VGG_LAYERS = {0: 64, 2: 64, 5: 128, 7: 128, 10: 256, 12: 256, 14: 256, 16: 256,
               19: 512, 21: 512, 23: 512, 25: 512, 28: 512}  # fmt: skip
_VGG_POOLS = (4, 9, 18, 27)
# Slices end behind relu2_1, relu3_1, relu4_1 and relu5_1.
_VGG_WEIGHTS = {5: 1 / 16, 10: 1 / 8, 19: 1 / 4, 28: 1.0}
# Largest file that is read; torchvision's has 575 MB.
_MAX_BYTES = 1 << 30
_MEAN, _STD = (0.485, 0.456, 0.406), (0.229, 0.224, 0.225)


class FilterBankLoss(nn.Module):
    """Oriented edges and colours at four scales, compared after pooling; it needs no file.

    At each octave below the full resolution, which the reconstruction sees, the luma is
    differentiated along four directions, split into its bright-dark and dark-bright halves, and
    averaged over 2 x 2 pixels, so that an edge that is a pixel off costs less than an edge that
    is missing. Colours are compared too.

    Source: the plan of a perceptual loss (Johnson et al., "Perceptual losses for real-time style
    transfer and super-resolution") with Freeman and Adelson's idea of oriented filters instead of
    learnt ones.
    """

    def forward(self, prediction: Tensor, target: Tensor, weights: Tensor) -> Tensor:
        """Mean over scales of the mean difference of responses.

        Args:
            prediction: (B, H, W, 3) float, sRGB.
            target: (B, H, W, 3).
            weights: (B, H, W) W.

        Returns:
            scalar, differentiable in `prediction` and `weights`; 0 for equal images.

        Raises:
            ShapeMismatch: the three do not describe the same images.
        """
        images = _pool(_weighted(prediction, target, weights))
        total = prediction.new_zeros(())
        for _ in range(SCALES):
            total = total + _difference(images) + _edge_difference(_luma(images))
            if min(images.shape[-2:]) < _LEAST_EDGE:
                break
            images = _pool(images)
        return total / SCALES


class Vgg19(nn.Module):
    """Features of VGG-19 behind relu2_1 to relu5_1, weighted 1/16, 1/8, 1/4 and 1.

    Args:
        weights: a file of the user's with torchvision's parameters of VGG-19: .safetensors, or
            a checkpoint that holds tensors only.

    Raises:
        BadInput: it is missing, unreadable, or lacks a layer.

    Source: Simonyan and Zisserman, "Very deep convolutional networks for large-scale image
    recognition", configuration E. The paper does not name the slices; these are the last four of
    the five that are usual with these weights (Wang et al., pix2pixHD).
    """

    mean: Tensor
    std: Tensor

    def __init__(self, weights: str | os.PathLike[str]) -> None:
        super().__init__()
        self.layers = nn.ModuleDict()
        before = 3
        for place, channels in _VGG_LAYERS.items():
            # Without memory: its tensors are those of the file.
            self.layers[str(place)] = nn.Conv2d(before, channels, 3, padding=1, device="meta")
            before = channels
        _fill(self.layers, read_tensors(weights, _MAX_BYTES), Path(weights))
        self.requires_grad_(False)
        self.register_buffer("mean", torch.tensor(_MEAN)[:, None, None], persistent=False)
        self.register_buffer("std", torch.tensor(_STD)[:, None, None], persistent=False)

    def forward(self, prediction: Tensor, target: Tensor, weights: Tensor) -> Tensor:
        """Sum of the weighted mean differences of features; arguments as in `FilterBankLoss`."""
        features = (_weighted(prediction, target, weights) - self.mean) / self.std
        total = prediction.new_zeros(())
        for place in range(max(_VGG_LAYERS) + 1):
            if place in _VGG_LAYERS:
                features = torch.relu(self.layers[str(place)](features))
                if place in _VGG_WEIGHTS:
                    total = total + _VGG_WEIGHTS[place] * _difference(features)
            elif place in _VGG_POOLS:
                features = nn.functional.max_pool2d(features, 2, ceil_mode=True)
        return total


def _weighted(prediction: Tensor, target: Tensor, weights: Tensor) -> Tensor:
    """W times both images, the predictions first: (2 B, 3, H, W); bad target pixels left out."""
    if prediction.shape != target.shape or weights.shape != prediction.shape[:-1]:
        raise ShapeMismatch(
            f"are {tuple(prediction.shape)}, {tuple(target.shape)} and {tuple(weights.shape)}",
            field="prediction, target, weights",
        )
    target = torch.where(target.isfinite(), target, prediction.detach())
    both = torch.cat([prediction, target]) * torch.cat([weights, weights])[..., None]
    return both.permute(0, 3, 1, 2).contiguous()


def _difference(responses: Tensor) -> Tensor:
    first, second = responses.chunk(2)
    return (first - second).abs().mean()


def _luma(images: Tensor) -> Tensor:
    red, green, blue = images.unbind(1)
    return LUMA[0] * red + LUMA[1] * green + LUMA[2] * blue


def _edge_difference(luma: Tensor) -> Tensor:
    """Difference of the pooled halves of four derivatives of (2 B, H, W)."""
    if min(luma.shape[-2:]) < 3:
        return luma.new_zeros(())
    slopes = torch.stack(
        [
            luma[:, 1:-1, 2:] - luma[:, 1:-1, :-2],
            luma[:, 2:, 1:-1] - luma[:, :-2, 1:-1],
            luma[:, 2:, 2:] - luma[:, :-2, :-2],
            luma[:, 2:, :-2] - luma[:, :-2, 2:],
        ],
        dim=1,
    )
    rising = _pool(torch.relu(slopes))
    # Rising minus falling half is the slope itself.
    return _difference(rising) + _difference(rising - _pool(slopes))


def _pool(images: Tensor) -> Tensor:
    # An image of one row or column has nothing to pool there.
    return nn.functional.avg_pool2d(images, 2, ceil_mode=True)


def _fill(layers: nn.ModuleDict, values: dict[str, Tensor], path: Path) -> None:
    for place, layer in layers.items():
        found = {}
        for kind, parameter in layer.named_parameters():
            name = f"features.{place}.{kind}"
            value = values.get(name)
            if value is None or value.shape != parameter.shape or not value.is_floating_point():
                raise BadInput(
                    f"is missing or not of shape {tuple(parameter.shape)}",
                    where=path,
                    field=name,
                    remedy="The file must hold torchvision's VGG-19.",
                )
            found[kind] = value.float()
        layer.load_state_dict(found, assign=True)
