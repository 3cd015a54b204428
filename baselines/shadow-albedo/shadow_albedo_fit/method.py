"""The plain fit under one lamp that casts shadows, in the manner of HARP."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property

import torch

from hwp_bench.methods.settings import number
from shadow_albedo_fit.model import RADIUS, ShadowedModel
from wildghand.gaussians.regularizers import SurfaceLaplacian, surface_laplacian
from wildghand.gaussians.shading import MAX_DEGREE
from wildghand.plain.model import PlainModel
from wildghand.plain.recipe import Batch, Drawing, FitSettings, Material, PlainRecipe, RecipeMethod


@dataclass(frozen=True)
class ShadowSettings(FitSettings):
    """The plain fit's settings, and those of the light."""

    #: Degree of a light by spherical harmonics on top of the lamp: 0, none, as in HARP, to 3.
    shading_degree: int = number(0, 0, MAX_DEGREE)
    #: Whether the lamp casts shadows.
    shadows: bool = True
    #: Edge of the image of the hand that the lamp sees, px.
    shadow_size: int = number(256, 16, 2048)
    #: Share of the light that comes from everywhere at the start; sigmoid(0.4), as in HARP.
    ambient: float = number(0.6, 0.01, 0.99)
    #: Adam step of the lamp's place, m.
    lamp_rate: float = 0.03
    #: Adam step of the logit of the ambient share.
    ambient_rate: float = 0.03
    #: Weight of the roughness of the albedo over the surface.
    albedo_smoothness: float = number(0.0, 0.0, 1e4)
    #: Weight of the roughness of the offsets over the surface.
    offset_smoothness: float = number(0.0, 0.0, 1e4)


# A lamp over the camera's shoulder lights most of what is seen: up and back, camera axes.
_START = (0.0, -1.0, -1.0)
# Albedos at the start are at most this.
_BRIGHTEST = 0.95


class ShadowRecipe(PlainRecipe[ShadowSettings]):
    """The plain fit of a `ShadowedModel`."""

    model: ShadowedModel

    def __init__(self, material: Material, settings: ShadowSettings) -> None:
        super().__init__(material, settings)
        # Cameras and posed anchors are known from here on.
        anchors = self.clip.poses(torch.arange(1))
        turn = self.clip.viewmats[0, :3, :3].mT
        away = turn @ torch.tensor(_START, device=material.device)
        with torch.no_grad():
            self.model.lamp.copy_(anchors.positions.mean(dim=(0, 1)) + RADIUS * away / away.norm())
            # The mean colour of the frames is that of the lit hand; its albedo is brighter.
            colors = self.model.gaussians.logit_colors
            albedo = (colors.sigmoid() / self.model.shading(anchors).mean()).clamp(max=_BRIGHTEST)
            colors.copy_(torch.logit(albedo, eps=1e-6))

    def start(self) -> PlainModel:
        """The plain model, and a lamp at the origin."""
        model, settings, device = super().start(), self.settings, self.material.device
        return ShadowedModel(
            **vars(model),
            lamp=torch.zeros(3, device=device),
            logit_ambient=torch.tensor(
                math.log(settings.ambient / (1.0 - settings.ambient)), device=device
            ),
            shadow_size=settings.shadow_size if settings.shadows else 0,
        )

    @cached_property
    def laplacians(self) -> list[SurfaceLaplacian]:
        """Of each hand."""
        return [surface_laplacian(rig) for rig in self.model.rigs.values()]

    def loss(self, batch: Batch, drawing: Drawing, weights: torch.Tensor) -> torch.Tensor:
        """The photometric loss, and the roughness of albedo and offsets."""
        loss = super().loss(batch, drawing, weights)
        settings, gaussians = self.settings, self.model.gaussians
        sections = self.model.sections(list(self.model.rigs))
        if not (settings.albedo_smoothness or settings.offset_smoothness):
            return loss
        for section, laplacian in zip(sections, self.laplacians, strict=True):
            if settings.albedo_smoothness:
                albedo = gaussians.logit_colors[section].sigmoid()
                loss = loss + settings.albedo_smoothness * laplacian.roughness(albedo)
            if settings.offset_smoothness:
                rough = laplacian.offsets(gaussians.offsets[section])
                loss = loss + settings.offset_smoothness * rough
        return loss


class ShadowMethod(RecipeMethod):
    """The plain fit under one lamp that casts shadows; see `ShadowRecipe`."""

    name = "baselines/shadow-albedo"
    settings_type = ShadowSettings
    recipe_type = ShadowRecipe
