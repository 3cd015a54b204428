"""The plain model: anchored Gaussians of one or two hands, lit by harmonics; its avatar."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace

import torch

from hwp_bench.hands import HandTemplate
from wildghand.gaussians.attributes import AnchoredGaussians, flat_gaussians
from wildghand.gaussians.hand_avatar import HandAvatar, PosedHands
from wildghand.gaussians.quaternions import quat_third_axis
from wildghand.gaussians.rig import AnchorPoses, HandRig, make_rig
from wildghand.gaussians.shading import sh_basis, sh_count
from wildghand.gaussians.training import join_hands
from wildghand.splat import rasterize


@dataclass(frozen=True, eq=False)
class PlainModel:
    """Everything that is fitted, and the rigs that carry it."""

    #: The rig of each hand, by side; the Gaussians of the hands follow in this order.
    rigs: Mapping[str, HandRig]
    #: Gaussians of all hands.
    gaussians: AnchoredGaussians
    #: (K, 3) coefficients of the log light by colour, the constant one left out: it could not
    #: be told from the Gaussians' colours.
    light: torch.Tensor
    #: Degree of the spherical harmonics.
    degree: int

    def parameters(self) -> dict[str, torch.Tensor]:
        """The fitted tensors by name, in a fixed order."""
        return {**self.gaussians.parameters(), "light": self.light}

    def with_parameters(self, values: Mapping[str, torch.Tensor]) -> PlainModel:
        """The same rigs with other values, named as in `parameters`."""
        rest = {name: value for name, value in values.items() if name != "light"}
        return replace(self, gaussians=AnchoredGaussians(**rest), light=values["light"])

    def finite(self) -> bool:
        """Whether every fitted number is finite."""
        return all(bool(value.isfinite().all()) for value in self.parameters().values())

    def snapshot(self) -> PlainModel:
        """A copy that the fit no longer changes."""
        copies = {name: value.detach().clone() for name, value in self.parameters().items()}
        return self.with_parameters(copies)

    def sections(self, sides: Sequence[str]) -> Iterator[slice]:
        """Where the Gaussians of the given hands lie, in the order of the rigs."""
        start = 0
        for side, rig in self.rigs.items():
            if side in sides:
                yield slice(start, start + len(rig))
            start += len(rig)

    def render(
        self, poses: AnchorPoses, viewmats: torch.Tensor, Ks: torch.Tensor, width: int, height: int
    ) -> tuple[torch.Tensor, torch.Tensor]:
        """Draw B frames over black; differentiable in the parameters.

        Args:
            poses: the anchors of all Gaussians in B frames.
            viewmats: (B, 4, 4) world to camera.
            Ks: (B, 3, 3) px.
            width, height: px.

        Returns:
            (B, H, W, 3) sRGB colour, premultiplied, and (B, H, W, 1) coverage in [0, 1].
        """
        colors = self.lit(self.gaussians.logit_colors.sigmoid(), poses)
        return self.rasterized(colors, poses, viewmats, Ks, width, height)

    def lit(self, colors: torch.Tensor, poses: AnchorPoses) -> torch.Tensor:
        """Multiply the light on; differentiable in the colours and the light.

        Args:
            colors: (N, 3) or (B, N, 3) sRGB without light.

        Returns:
            (B, N, 3) sRGB.
        """
        # The light is multiplied on in sRGB: the encoding is close to a power, and a power of a
        # product is the product of the powers.
        if self.degree:
            normals = quat_third_axis(poses.orientations)
            log_light = sh_basis(normals, self.degree)[..., 1:] @ self.light
            return colors * log_light.exp()
        return colors.expand(len(poses.positions), -1, -1)

    def rasterized(
        self,
        channels: torch.Tensor,
        poses: AnchorPoses,
        viewmats: torch.Tensor,
        Ks: torch.Tensor,
        width: int,
        height: int,
    ) -> tuple[torch.Tensor, torch.Tensor]:
        """Draw any channels of the Gaussians in B frames over zero; differentiable.

        Args:
            channels: (B, N, D), any number D; colours are three of them.
            viewmats: (B, 4, 4) world to camera.
            Ks: (B, 3, 3) px.
            width, height: px.

        Returns:
            (B, H, W, D), premultiplied, and (B, H, W, 1) coverage in [0, 1].
        """
        placed = self.gaussians.place(poses.positions, poses.orientations)
        image, coverage, _ = rasterize(*placed, channels, viewmats, Ks, width, height)
        return image, coverage


def make_model(
    templates: Mapping[str, HandTemplate],
    mean_color: torch.Tensor,
    *,
    gaussians: int,
    opacity: float,
    degree: int,
    seed: int,
    device: torch.device,
) -> PlainModel:
    """Cover the hands with flat Gaussians of one colour under even light.

    Args:
        mean_color: (3,) sRGB in [0, 1].
        opacity: of each Gaussian, in (0, 1).
    """
    rigs = {
        side: make_rig(template, gaussians, seed, device) for side, template in templates.items()
    }
    spacing = torch.cat([torch.full((len(rig),), rig.spacing) for rig in rigs.values()]).to(device)
    return PlainModel(
        rigs=rigs,
        gaussians=flat_gaussians(spacing, mean_color.to(device), opacity=opacity),
        light=torch.zeros(sh_count(degree) - 1, 3, device=device),
        degree=degree,
    )


class PlainAvatar(HandAvatar):
    """A fitted model that can be drawn in any pose; see `hwp_bench.methods.contract.Avatar`.

    Args:
        model: what to draw. While the fit runs it may be the live one.
        steps: optimizer steps behind it.
    """

    def __init__(self, model: PlainModel, steps: int) -> None:
        super().__init__(model.rigs, model.light.device, steps)
        self.model = model

    def draw(
        self,
        hands: PosedHands,
        viewmats: torch.Tensor,
        Ks: torch.Tensor,
        width: int,
        height: int,
    ) -> tuple[torch.Tensor, torch.Tensor]:
        """See `HandAvatar.draw`."""
        model = self.model
        poses = join_hands([model.rigs[side].pose(*posed) for side, posed in hands.items()])
        if len(hands) < len(model.rigs):
            sections = list(model.sections(list(hands)))
            chosen = {
                name: torch.cat([value[section] for section in sections])
                for name, value in model.gaussians.parameters().items()
            }
            model = replace(model, gaussians=AnchoredGaussians(**chosen))
        return model.render(poses, viewmats, Ks, width, height)
