"""The plain fit under one lamp, whose place and ambient share are fitted with the albedo."""

from __future__ import annotations

import math
from functools import cached_property

import torch

from shadow_albedo_fit.model import ShadowedModel
from shadow_albedo_fit.settings import ShadowSettings
from shadow_albedo_fit.visibility import RADIUS
from wildghand.gaussians.regularizers import SurfaceLaplacian, surface_laplacian
from wildghand.gaussians.rig import AnchorPoses
from wildghand.plain.model import PlainModel
from wildghand.plain.recipe import Batch, Drawing, Material, PlainRecipe

# A lamp over the camera's shoulder lights most of what is seen: up and back, camera axes.
_START = (0.0, -1.0, -1.0)
# Albedos at the start are at most this.
_BRIGHTEST = 0.95


class ShadowRecipe(PlainRecipe[ShadowSettings]):
    """The plain fit of a `ShadowedModel`.

    Args:
        material: what is fitted.
        settings: how.
    """

    model: ShadowedModel

    def __init__(self, material: Material, settings: ShadowSettings) -> None:
        super().__init__(material, settings)
        # Cameras and posed anchors are known from here on.
        anchors = self.clip.poses(torch.arange(1))
        turn = self.clip.viewmats[0, :3, :3].mT
        away = turn @ torch.tensor(_START, device=material.device)
        with torch.no_grad():
            self.model.lamp.copy_(anchors.positions.mean(dim=(0, 1)) + RADIUS * away / away.norm())
            self._brighten(anchors)

    def _brighten(self, anchors: AnchorPoses) -> None:
        """The mean colour of the frames is that of the lit hand; its albedo is brighter."""
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

    def rates(self) -> dict[str, float]:
        """Adam's step at the start of each tensor, by name."""
        settings = self.settings
        return {
            **super().rates(),
            "lamp": settings.lamp_rate,
            "logit_ambient": settings.ambient_rate,
        }

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
