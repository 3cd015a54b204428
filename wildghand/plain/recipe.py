"""The recipe of the plain fit: its hooks are all that a method may change of it."""

from __future__ import annotations

import math
from typing import TypeVar

import torch

from hwp_bench.methods.contract import Avatar
from wildghand.gaussians.training import TrainingClip
from wildghand.plain.hooks import Batch, Drawing, Material, Recipe
from wildghand.plain.model import PlainAvatar, PlainModel, make_model
from wildghand.plain.settings import FitSettings

# Standard deviations stay within these, m: thinner than paper or wider than a finger explains
# nothing of a hand.
_SCALES = (2e-5, 1e-2)

PlainSettings = TypeVar("PlainSettings", bound=FitSettings)


class PlainRecipe(Recipe[PlainSettings]):
    """The plain fit. A method is a subclass that overrides the hooks in which it differs.

    Args:
        material: what is fitted.
        settings: how.

    Attributes:
        model: what is fitted.
        clip: hands and cameras of the training frames.
    """

    def __init__(self, material: Material, settings: PlainSettings) -> None:
        super().__init__(material, settings)
        self.model = self.start()
        self.clip = TrainingClip(
            material.training, material.frames.indices, self.model.rigs, material.device
        )

    def start(self) -> PlainModel:
        """The model before the first step."""
        training, settings = self.material.training, self.settings
        return make_model(
            {side: training.template(side) for side in training.sides},
            self.material.frames.mean_color(),
            gaussians=settings.gaussians,
            opacity=settings.initial_opacity,
            degree=settings.shading_degree,
            seed=self.material.seed,
            device=self.material.device,
        )

    def parameters(self) -> dict[str, torch.Tensor]:
        """The tensors that Adam fits, by name, in a fixed order."""
        return self.model.parameters()

    def rates(self) -> dict[str, float]:
        """Adam's step at the start of each tensor, by name."""
        return learning_rates(self.settings)

    def draw(self, batch: Batch) -> Drawing:
        """Draw the frames of a batch; differentiable. The formation of an image is in here."""
        training, clip, rows = self.material.training, self.clip, batch.rows
        image, coverage = self.model.render(
            clip.poses(rows), clip.viewmats[rows], clip.Ks[rows], training.width, training.height
        )
        return Drawing(image, coverage)

    @torch.no_grad()
    def after_step(self, batch: Batch) -> None:
        """Called after Adam's step; keeps the tensors within their ranges."""
        low, high = _SCALES
        self.model.gaussians.log_scales.clamp_(math.log(low), math.log(high))

    def avatar(self, steps: int) -> Avatar:
        """The avatar that draws test frames; while the fit goes on it may share live tensors."""
        return PlainAvatar(self.model, steps)


def learning_rates(settings: FitSettings) -> dict[str, float]:
    """Adam's step at the start of the plain model's tensors, by name."""
    return {
        "offsets": settings.offset_rate,
        "log_scales": settings.scale_rate,
        "quats": settings.quat_rate,
        "logit_opacities": settings.opacity_rate,
        "logit_colors": settings.color_rate,
        "light": settings.light_rate,
    }
