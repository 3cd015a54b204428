"""The fit of a skin from principal components, in the manner of Handy."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from hwp_bench.base.colors import srgb_to_linear
from hwp_bench.methods.contract import Avatar
from hwp_bench.methods.settings import number
from texture_space_fit.model import SpaceModel
from texture_space_fit.skins import shipped_skins, skin_uv
from wildghand.gaussians.hand_avatar import DrawnAvatar
from wildghand.gaussians.rig import make_rig
from wildghand.gaussians.training import TrainingClip
from wildghand.plain.recipe import Batch, Drawing, LoopSettings, Material, Recipe, RecipeMethod


@dataclass(frozen=True)
class SpaceSettings(LoopSettings):
    """Those of the loop, and those of texture, light and shape."""

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

    def __init__(self, material: Material, settings: SpaceSettings) -> None:
        super().__init__(material, settings)
        training, device = material.training, material.device
        templates = {side: training.template(side) for side in training.sides}
        rigs = {
            side: make_rig(template, settings.gaussians, material.seed, device)
            for side, template in templates.items()
        }
        uv = {side: skin_uv(templates[side], rig.anchors) for side, rig in rigs.items()}
        color = srgb_to_linear(material.frames.mean_color().numpy())
        color = torch.as_tensor(color, dtype=torch.float32, device=device)
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
