"""The fit of a skin from principal components, in the manner of Handy."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from hwp_bench.base.arrays import read_npz
from hwp_bench.base.colors import srgb_to_linear
from hwp_bench.base.errors import BadInput
from hwp_bench.hands import HandTemplate, SurfaceAnchors, anchor_uv, load_template
from hwp_bench.methods.contract import Avatar
from hwp_bench.methods.settings import number
from wildghand.gaussians.attributes import AnchoredGaussians, flat_gaussians
from wildghand.gaussians.hand_avatar import DrawnAvatar, PosedHands
from wildghand.gaussians.quaternions import quat_third_axis
from wildghand.gaussians.rig import HandRig, make_rig
from wildghand.gaussians.shading import sh_basis, sh_count
from wildghand.gaussians.training import TrainingClip, join_hands
from wildghand.network.surface import bilinear_taps, mirrored_anchors
from wildghand.plain.recipe import Batch, Drawing, FitInputs, LoopSettings, Recipe, RecipeMethod
from wildghand.splat import rasterize

#: What `tools/paint_skins.py` made.
FILE = Path(__file__).with_name("skins.npz")
_MOST_BYTES = 64 * 1024 * 1024


@dataclass(frozen=True, eq=False)
class SkinSpace:
    """Mean and principal components of the logarithm of the albedo, row 0 at the top (v = 1)."""

    #: (S, S, 3) logarithm of the linear reflectance.
    mean: Tensor
    #: (K, S, S, 3), each as long as one standard deviation.
    components: Tensor

    def at(self, uv: Tensor) -> tuple[Tensor, Tensor]:
        """Mean (N, 3) and components (K, N, 3) at places (N, 2), read bilinearly."""
        index, weight = bilinear_taps(uv, len(self.mean))

        def read(planes: Tensor) -> Tensor:
            rows = planes.flatten(-3, -2)
            return (rows[..., index, :] * weight[..., None]).sum(dim=-2)

        return read(self.mean), read(self.components)


def shipped_skins() -> SkinSpace:
    """Read the space."""
    arrays = read_npz(FILE, max_bytes=_MOST_BYTES)
    mean, steps, scales = (arrays.get(name) for name in ("mean", "components", "scales"))
    if mean is None or steps is None or scales is None or steps.shape[1:] != mean.shape:
        raise BadInput("is not a space of textures", where=FILE)
    components = steps.astype(np.float32) * scales[:, None, None, None]
    return SkinSpace(
        torch.from_numpy(mean.astype(np.float32)), torch.from_numpy(components.astype(np.float32))
    )


def skin_uv(template: HandTemplate, anchors: SurfaceAnchors) -> Tensor:
    """Where anchors read the skin: (N, 2); both hands wear that of the right one, mirrored."""
    right = load_template("anny", "right")
    if len(template.faces) != len(right.faces) or not template.name.startswith("anny"):
        raise BadInput(
            f"has no skins, and {template.name} is the capture's",
            field="hand_model",
            remedy="This method fits captures of the free hand model only.",
        )
    if template.side == "left":
        anchors = mirrored_anchors(anchors)
    return torch.as_tensor(anchor_uv(right, anchors), dtype=torch.float32)


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
    """One or two hands of one person; the light starts from the hand's mean linear colour.

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


@dataclass(frozen=True)
class SpaceSettings(LoopSettings):
    """Settings of the loop, and those of texture, light and shape."""

    #: Adam step of the weights of the components, in standard deviations.
    latent_rate: float = 0.03
    #: Adam step of the light's coefficients, as shares of its mean.
    light_rate: float = 0.03
    #: Adam step of the shape parameters.
    betas_rate: float = 3e-3
    #: Weight of the mean square of the components' weights.
    latent_weight: float = number(1e-4, 0.0, 1e4)
    #: Adam step of a logarithm of the albedo that each Gaussian has to itself; 0 for none, as in
    #: Handy.
    residual_rate: float = 0.0
    #: Weight of the mean square of what Gaussians have to themselves.
    residual_weight: float = number(1e-3, 0.0, 1e4)
    #: Weight of the coverage's distance to the mask.
    mask_weight: float = number(0.1, 0.0, 1e4)


class SpaceRecipe(Recipe[SpaceSettings]):
    """Fit the weights of the space, a light and the shape."""

    def __init__(self, material: FitInputs, settings: SpaceSettings) -> None:
        super().__init__(material, settings)
        training, device = material.training, material.device
        templates = {side: training.template(side) for side in training.sides}
        rigs = {
            side: make_rig(template, settings.gaussians, material.seed, device)
            for side, template in templates.items()
        }
        uv = {side: skin_uv(templates[side], rig.anchors) for side, rig in rigs.items()}
        linear = srgb_to_linear(material.frames.mean_color().numpy())
        color = torch.as_tensor(linear, dtype=torch.float32, device=device)
        self.model = SpaceModel(rigs, uv, shipped_skins(), color)
        self.clip = TrainingClip(training, material.frames.indices, rigs, device)

    def parameters(self) -> dict[str, Tensor]:
        """See `Recipe`."""
        found = self.model.parameters()
        if self.settings.residual_rate == 0.0:
            found = {name: value for name, value in found.items() if "residual" not in name}
        return found

    def draw(self, batch: Batch) -> Drawing:
        """See `Recipe`."""
        training, clip = self.material.training, self.clip
        rows = batch.rows.to(self.device)
        hands = {
            side: (pose[rows], betas, transl[rows])
            for side, (pose, betas, transl) in clip.parameters.items()
        }
        image, coverage = self.model.draw(
            hands, clip.viewmats[rows], clip.Ks[rows], training.width, training.height
        )
        return Drawing(image, coverage)

    def loss(self, batch: Batch, drawing: Drawing, weights: Tensor) -> Tensor:
        """See `Recipe`: the photometric loss, the silhouette, and what keeps the skin likely."""
        settings, model = self.settings, self.model
        loss = super().loss(batch, drawing, weights)
        loss = loss + settings.mask_weight * self.outline(batch, drawing, weights)
        loss = loss + settings.latent_weight * model.latent.square().mean()
        if settings.residual_rate:
            squares = [value.square().mean() for value in model.residual.values()]
            loss = loss + settings.residual_weight * torch.stack(squares).mean()
        return loss

    def avatar(self, steps: int) -> Avatar:
        """See `Recipe`."""
        return DrawnAvatar(self.model.draw, self.model.hands, self.device, steps)


class SpaceMethod(RecipeMethod):
    """See `texture_space_fit.method.SpaceRecipe` for all that it does."""

    name = "baselines/texture-space"
    settings_type = SpaceSettings
    recipe_type = SpaceRecipe
