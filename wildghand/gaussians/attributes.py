"""Gaussians on anchors: raw attributes, activated ones, and their places in a frame."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field, fields
from types import MappingProxyType
from typing import NamedTuple

import torch
from torch import Tensor

from hwp_bench.base.errors import ShapeMismatch
from wildghand.gaussians.quaternions import quat_multiply, quat_rotate

#: Channels of each raw attribute, in the order in which they are concatenated.
SIZES: Mapping[str, int] = MappingProxyType(
    {"offsets": 3, "log_scales": 3, "quats": 4, "logit_opacities": 1, "logit_colors": 3}
)

#: Channels of all of them.
CHANNELS = sum(SIZES.values())


@dataclass(frozen=True, eq=False)
class RawAttributes:
    """The network's predictions, to which DPD adds its biases; `Activation` makes them drawable.

    Leading dimensions are B frames or none. A sum broadcasts them, so that attributes of all
    frames, (N, k), and biases of each frame, (B, N, k), add up to (B, N, k).
    """

    #: (..., N, 3) displacement in the anchor's frame before the bound.
    offsets: Tensor
    #: (..., N, 3) natural logarithms of the standard deviations, relative to a bias.
    log_scales: Tensor
    #: (..., N, 4) orientation in the anchor's frame, (w, x, y, z), any length but 0.
    quats: Tensor
    #: (..., N, 1) opacity before the sigmoid.
    logit_opacities: Tensor
    #: (..., N, 3) sRGB colour before the sigmoid.
    logit_colors: Tensor
    # What `split` has made them of: `concatenate` need not make it again. `replace` drops it.
    _joined: Tensor | None = field(default=None, init=False, repr=False)

    def __post_init__(self) -> None:
        for name, tensor in self.items():
            if tensor.ndim < 2 or tensor.shape[-1] != SIZES[name]:
                raise ShapeMismatch(
                    f"is {tuple(tensor.shape)}, expected (..., N, {SIZES[name]})", field=name
                )

    def __len__(self) -> int:
        """N."""
        return self.offsets.shape[-2]

    def items(self) -> Iterator[tuple[str, Tensor]]:
        """Name and tensor of each attribute, in the order of `SIZES`."""
        return ((name, getattr(self, name)) for name in SIZES)

    def __add__(self, other: RawAttributes) -> RawAttributes:
        """Attribute by attribute, leading dimensions broadcast."""
        added = {name: tensor + getattr(other, name) for name, tensor in self.items()}
        return RawAttributes(**added)

    def map(self, function: Callable[[Tensor], Tensor]) -> RawAttributes:
        """Apply a function to each tensor."""
        return RawAttributes(**{name: function(tensor) for name, tensor in self.items()})

    def concatenate(self) -> Tensor:
        """All channels side by side: (..., N, 14), in the order of `SIZES`."""
        if self._joined is not None:
            return self._joined
        return torch.cat([tensor for _, tensor in self.items()], dim=-1)

    @classmethod
    def split(cls, channels: Tensor) -> RawAttributes:
        """Take (..., N, 14) channels apart: the inverse of `concatenate`."""
        if channels.ndim < 2 or channels.shape[-1] != CHANNELS:
            raise ShapeMismatch(
                f"are {tuple(channels.shape)}, expected (..., N, {CHANNELS})", field="channels"
            )
        parts = channels.split(list(SIZES.values()), dim=-1)
        made = cls(**dict(zip(SIZES, parts, strict=True)))
        object.__setattr__(made, "_joined", channels)
        return made


@dataclass(frozen=True, eq=False)
class Attributes:
    """Gaussians in their anchors' frames, in the units of the rasterizer."""

    #: (..., N, 3) m, from the anchor, in its frame.
    offsets: Tensor
    #: (..., N, 3) standard deviations in m.
    scales: Tensor
    #: (..., N, 4) of length 1, orientation in the anchor's frame.
    quats: Tensor
    #: (..., N) in (0, 1).
    opacities: Tensor
    #: (..., N, 3) sRGB in (0, 1), before the shadow coefficient.
    colors: Tensor


#: Largest standard deviation of a Gaussian, m, unless a fit says otherwise: one as wide as a finger
#: explains nothing of a hand, and costs time.
MAX_SCALE = 1e-2


@dataclass(frozen=True)
class Activation:
    """Turns raw attributes into attributes."""

    #: Largest displacement from the anchor along each axis of its frame, m. The authors' form
    #: (sigmoid - 0.5) * 1.2 / 32 is the same function with 0.01875.
    max_offset: float = 0.01875
    #: Added to the raw logarithms of the scales; exp(-5) is 6.7 mm (the authors' value).
    log_scale_bias: float = -5.0
    #: Smallest standard deviation, m; thinner than paper explains nothing of a hand.
    min_scale: float = 2e-5
    #: Largest standard deviation, m.
    max_scale: float = MAX_SCALE

    def __call__(self, raw: RawAttributes) -> Attributes:
        """Activate (..., N, k): bounded offsets and exponentials, unit quaternions, sigmoids."""
        return Attributes(
            # tanh(x / 2) = 2 (sigmoid(x) - 0.5)
            offsets=self.max_offset * torch.tanh(0.5 * raw.offsets),
            scales=torch.exp(
                (raw.log_scales + self.log_scale_bias).clamp(
                    math.log(self.min_scale), math.log(self.max_scale)
                )
            ),
            quats=torch.nn.functional.normalize(raw.quats, dim=-1),
            opacities=raw.logit_opacities.squeeze(-1).sigmoid(),
            colors=raw.logit_colors.sigmoid(),
        )


#: Logits are kept within +-this at the start, so that their gradient has not died.
MAX_LOGIT = 6.0


@dataclass(frozen=True, eq=False)
class AnchoredGaussians:
    """The canonical attributes of N Gaussians, one set for every frame.

    Each Gaussian has an anchor on the hand's surface. Its offset and orientation are expressed
    in the anchor's frame, whose z axis is the surface normal; so they follow the skin.
    """

    #: (N, 3) m, from the anchor, in its frame.
    offsets: Tensor
    #: (N, 3) natural logarithms of the standard deviations in m.
    log_scales: Tensor
    #: (N, 4) orientation in the anchor's frame, (w, x, y, z), any length but 0.
    quats: Tensor
    #: (N,) opacity before the sigmoid.
    logit_opacities: Tensor
    #: (N, 3) sRGB colour before the sigmoid.
    logit_colors: Tensor

    def __len__(self) -> int:
        return len(self.offsets)

    def parameters(self) -> dict[str, Tensor]:
        """The tensors by name, in a fixed order."""
        return {item.name: getattr(self, item.name) for item in fields(self)}

    def place(self, positions: Tensor, orientations: Tensor) -> PlacedGaussians:
        """Carry the Gaussians into B frames, without their colours.

        `positions` are (B, N, 3) m, `orientations` (B, N, 4) unit quaternions, both of the anchors.
        """
        if positions.shape[1:] != (len(self), 3) or orientations.shape[1:] != (len(self), 4):
            raise ShapeMismatch(
                f"are {tuple(positions.shape)} and {tuple(orientations.shape)} "
                f"for {len(self)} Gaussians",
                field="positions, orientations",
            )
        quats = torch.nn.functional.normalize(self.quats, dim=-1)
        return PlacedGaussians(
            means=positions + quat_rotate(orientations, self.offsets),
            quats=quat_multiply(orientations, quats),
            scales=self.log_scales.exp(),
            opacities=self.logit_opacities.sigmoid(),
        )


class PlacedGaussians(NamedTuple):
    """Gaussians in B frames, in the order and shapes that `wildghand.splat.rasterize` takes."""

    means: Tensor  # (B, N, 3) m, world
    quats: Tensor  # (B, N, 4) of length 1, world
    scales: Tensor  # (N, 3) m
    opacities: Tensor  # (N,) in (0, 1)


def flat_gaussians(
    spacing: Tensor,
    colors: Tensor,
    *,
    opacity: float,
    width: float = 0.6,
    thickness: float = 0.2,
) -> AnchoredGaussians:
    """Discs that lie on the surface and just cover it.

    `spacing` is (N,) m to the neighbouring anchors, the unit of `width` along the surface and
    `thickness` along the normal, both standard deviations; `colors` are (N, 3) or (3,) sRGB.
    """
    count = len(spacing)
    sigmas = torch.log(spacing.clamp(min=1e-7))[:, None].repeat(1, 3)
    sigmas[:, :2] += math.log(width)
    sigmas[:, 2] += math.log(thickness)
    quats = spacing.new_zeros(count, 4)
    quats[:, 0] = 1.0
    logits = torch.logit(colors.to(spacing), eps=1e-6).clamp(-MAX_LOGIT, MAX_LOGIT)
    return AnchoredGaussians(
        offsets=spacing.new_zeros(count, 3),
        log_scales=sigmas,
        quats=quats,
        logit_opacities=spacing.new_full((count,), math.log(opacity / (1.0 - opacity))),
        logit_colors=logits.expand(count, 3).clone(),
    )
