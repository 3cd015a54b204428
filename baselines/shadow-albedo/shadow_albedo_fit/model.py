"""The plain model under one lamp: albedo (a + (1 - a) max(0, n . l) V)."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import torch

from shadow_albedo_fit.visibility import visibility
from wildghand.gaussians.quaternions import quat_third_axis
from wildghand.gaussians.rig import AnchorPoses
from wildghand.plain.model import PlainModel


@dataclass(frozen=True, eq=False)
class ShadowedModel(PlainModel):
    """The plain model, whose colours are albedos, and a lamp at one place in all frames."""

    #: (3,) m, world.
    lamp: torch.Tensor
    #: () share of the light that comes from everywhere, before the sigmoid.
    logit_ambient: torch.Tensor
    #: Edge of the lamp's image of the hand, px; 0 for a lamp that casts no shadows.
    shadow_size: int

    def parameters(self) -> dict[str, torch.Tensor]:
        """The fitted tensors by name, in a fixed order."""
        return {**super().parameters(), "lamp": self.lamp, "logit_ambient": self.logit_ambient}

    def with_parameters(self, values: Mapping[str, torch.Tensor]) -> ShadowedModel:
        """The same rigs with other values, named as in `parameters`."""
        rest = {k: value for k, value in values.items() if k not in ("lamp", "logit_ambient")}
        made = super().with_parameters(rest)
        assert isinstance(made, ShadowedModel)
        return replace(made, lamp=values["lamp"], logit_ambient=values["logit_ambient"])

    def lit(self, colors: torch.Tensor, poses: AnchorPoses) -> torch.Tensor:
        """Multiply the light on; differentiable in the colours and the light.

        Args:
            colors: (N, 3) or (B, N, 3) albedo, sRGB.
            poses: the anchors of all Gaussians in B frames.

        Returns:
            (B, N, 3) sRGB.
        """
        # As in HARP the light is multiplied on in sRGB.
        return super().lit(colors, poses) * self.shading(poses)[..., None]

    def shading(self, poses: AnchorPoses) -> torch.Tensor:
        """The share of the light that reaches each anchor; differentiable in lamp and ambient.

        Returns:
            (B, N) in [0, 1].
        """
        towards = torch.nn.functional.normalize(self.lamp - poses.positions, dim=-1)
        facing = (quat_third_axis(poses.orientations) * towards).sum(dim=-1).relu()
        if self.shadow_size:
            spacing = max(rig.spacing for rig in self.rigs.values())
            facing = facing * visibility(poses, self.lamp.detach(), spacing, self.shadow_size)
        ambient = self.logit_ambient.sigmoid()
        return ambient + (1.0 - ambient) * facing
