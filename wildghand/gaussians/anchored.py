"""Gaussians that ride on the posed hand: canonical attributes, and placing them in a frame."""

from __future__ import annotations

import math
from dataclasses import dataclass, fields

import torch

from hwp_bench.base.errors import ShapeMismatch
from wildghand.gaussians.quaternions import quat_multiply, quat_rotate

#: Logits are kept within +-this at the start, so that their gradient has not died.
MAX_LOGIT = 6.0


@dataclass(frozen=True, eq=False)
class AnchoredGaussians:
    """The canonical attributes of N Gaussians, one set for every frame.

    Each Gaussian has an anchor on the hand's surface. Its offset and orientation are expressed
    in the anchor's frame, whose z axis is the surface normal; so they follow the skin.
    """

    #: (N, 3) m, from the anchor, in its frame.
    offsets: torch.Tensor
    #: (N, 3) natural logarithms of the standard deviations in m.
    log_scales: torch.Tensor
    #: (N, 4) orientation in the anchor's frame, (w, x, y, z), any length but 0.
    quats: torch.Tensor
    #: (N,) opacity before the sigmoid.
    logit_opacities: torch.Tensor
    #: (N, 3) sRGB colour before the sigmoid.
    logit_colors: torch.Tensor

    def __len__(self) -> int:
        return len(self.offsets)

    def parameters(self) -> dict[str, torch.Tensor]:
        """The tensors by name, in a fixed order."""
        return {item.name: getattr(self, item.name) for item in fields(self)}

    def place(self, positions: torch.Tensor, orientations: torch.Tensor) -> PlacedGaussians:
        """Carry the Gaussians into B frames.

        Args:
            positions: (B, N, 3) m, world, of the anchors.
            orientations: (B, N, 4) unit quaternions, world, of the anchors' frames.

        Returns:
            The arguments of the rasterizer, except the colours.

        Raises:
            ShapeMismatch: not N anchors.
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


@dataclass(frozen=True, eq=False)
class PlacedGaussians:
    """Gaussians in B frames, in the shapes that `wildghand.splat.rasterize` takes."""

    #: (B, N, 3) m, world.
    means: torch.Tensor
    #: (B, N, 4) of length 1, world.
    quats: torch.Tensor
    #: (N, 3) m.
    scales: torch.Tensor
    #: (N,) in (0, 1).
    opacities: torch.Tensor


def flat_gaussians(
    spacing: torch.Tensor,
    colors: torch.Tensor,
    *,
    opacity: float,
    width: float = 0.6,
    thickness: float = 0.2,
) -> AnchoredGaussians:
    """Discs that lie on the surface and just cover it.

    Args:
        spacing: (N,) m, distance to the neighbouring anchors.
        colors: (N, 3) or (3,) sRGB in [0, 1].
        opacity: in (0, 1).
        width: standard deviation along the surface, in units of the spacing.
        thickness: standard deviation along the normal, in units of the spacing.
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
