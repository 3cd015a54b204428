"""Hands of opaque discs whose colour is a skin of the space under a light."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import torch
from torch import Tensor

from texture_space_fit.skins import SkinSpace
from wildghand.gaussians.attributes import AnchoredGaussians, flat_gaussians
from wildghand.gaussians.hand_avatar import PosedHands
from wildghand.gaussians.quaternions import quat_third_axis
from wildghand.gaussians.rig import HandRig
from wildghand.gaussians.shading import sh_basis, sh_count
from wildghand.gaussians.training import join_hands
from wildghand.splat import rasterize

# Degree of the light: nine coefficients for each colour.
_DEGREE = 2
_OPACITY, _WIDTH, _THICKNESS = 0.98, 0.55, 0.1
# No place is darker than this share of the mean light, nor brighter than that.
_LEAST_LIGHT, _MOST_COLOR = 0.02, 4.0


@dataclass(frozen=True, eq=False)
class SpaceHand:
    """Facts about one hand before the fit."""

    #: The hand.
    rig: HandRig
    #: Discs on its surface.
    discs: AnchoredGaussians
    #: (N, 3) mean of the space at the anchors, log albedo.
    mean: Tensor
    #: (K, N, 3) its components.
    components: Tensor


class SpaceModel:
    """One or two hands of one person.

    Args:
        rigs: by side.
        uv: (N, 2) where the anchors of each hand read the skin.
        skins: the space.
        color: (3,) mean linear colour of the hand, which the light starts from.

    Attributes:
        latent: (K,) weights of the components, in standard deviations.
        light: (9, 3) coefficients of the light, as shares of `brightness`.
        betas: by side, (10,) added to the given ones.
        residual: by side, (N, 3) log albedo that each disc has to itself.
        brightness: (3,) mean light; not fitted.
    """

    def __init__(
        self,
        rigs: Mapping[str, HandRig],
        uv: Mapping[str, Tensor],
        skins: SkinSpace,
        color: Tensor,
    ) -> None:
        self.hands: dict[str, SpaceHand] = {}
        for side, rig in rigs.items():
            mean, components = (part.to(color.device) for part in skins.at(uv[side]))
            spacing = torch.full((len(rig),), rig.spacing, device=color.device)
            discs = flat_gaussians(
                spacing, color, opacity=_OPACITY, width=_WIDTH, thickness=_THICKNESS
            )
            self.hands[side] = SpaceHand(rig, discs, mean, components)
        albedo = torch.cat([hand.mean for hand in self.hands.values()]).exp().mean(dim=0)
        self.brightness = color / albedo
        self.latent = color.new_zeros(len(skins.components))
        self.light = color.new_zeros(sh_count(_DEGREE), 3)
        self.light[0] = 1.0
        self.betas = {side: color.new_zeros(10) for side in rigs}
        self.residual = {side: torch.zeros_like(hand.mean) for side, hand in self.hands.items()}

    def parameters(self) -> dict[str, Tensor]:
        """The fitted tensors by name."""
        return {
            "latent": self.latent,
            "light": self.light,
            **{f"betas.{side}": value for side, value in self.betas.items()},
            **{f"residual.{side}": value for side, value in self.residual.items()},
        }

    def albedo(self, side: str) -> Tensor:
        """(N, 3) linear reflectance of each disc."""
        hand = self.hands[side]
        mixed = torch.tensordot(self.latent, hand.components, dims=1)
        return (hand.mean + mixed + self.residual[side]).exp()

    def colors(self, side: str, normals: Tensor) -> Tensor:
        """The colours of discs with these normals, (B, N, 3): (B, N, 3) sRGB."""
        light = (sh_basis(normals, _DEGREE) @ self.light).clamp(min=_LEAST_LIGHT)
        linear = self.albedo(side) * light * self.brightness
        return to_srgb(linear.clamp(max=_MOST_COLOR))

    def draw(
        self, hands: PosedHands, viewmats: Tensor, Ks: Tensor, width: int, height: int
    ) -> tuple[Tensor, Tensor]:
        """Draw B frames over black; differentiable. See `HandAvatar.draw`."""
        posed = {
            side: self.hands[side].rig.follow(pose, betas + self.betas[side], transl)
            for side, (pose, betas, transl) in hands.items()
        }
        joined = join_hands(list(posed.values()))
        colors = [
            self.colors(side, quat_third_axis(anchors.orientations))
            for side, anchors in posed.items()
        ]
        discs = [self.hands[side].discs for side in posed]
        image, coverage, _ = rasterize(
            joined.positions,
            joined.orientations,
            torch.cat([one.log_scales for one in discs]).exp(),
            torch.cat([one.logit_opacities for one in discs]).sigmoid(),
            torch.cat(colors, dim=1),
            viewmats,
            Ks,
            width,
            height,
        )
        return image, coverage


def to_srgb(linear: Tensor) -> Tensor:
    """The sRGB curve, differentiable: linear 0 and more to sRGB 0 and more."""
    bent = 1.055 * linear.clamp(min=0.0031308) ** (1.0 / 2.4) - 0.055
    return torch.where(linear <= 0.0031308, 12.92 * linear, bent)
