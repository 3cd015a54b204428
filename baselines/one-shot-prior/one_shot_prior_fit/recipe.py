"""The recipe of the one-shot prior: the hooks in which it differs."""

from __future__ import annotations

from dataclasses import replace

import torch

from hwp_bench.methods.contract import Avatar
from one_shot_prior_fit.chosen_frame import choose_frame, only
from one_shot_prior_fit.model import OneShotAvatar, OneShotModel
from one_shot_prior_fit.settings import OneShotSettings
from wildghand.gaussians.perceptual import FilterBankLoss
from wildghand.gaussians.training import TrainingClip
from wildghand.model.terms import silhouette
from wildghand.plain.hooks import Batch, Drawing, Material, Recipe

#: Shares of the budget after which rates are halved: the original's epochs of its hundred.
HALVED_AFTER = (0.02, 0.05, 0.10, 0.20, 0.35, 0.50, 0.75)


class OneShotRecipe(Recipe[OneShotSettings]):
    """Fit the identity map, the bias of the texture plane, and one gain and offset.

    Attributes:
        fitted: the frozen network and what is fitted.
        clip: hands and cameras of the frames that are fitted.
    """

    def __init__(self, material: Material, settings: OneShotSettings) -> None:
        if settings.frames == "one":
            frames = only(material.frames, choose_frame(material.frames))
            material = replace(material, frames=frames)
        super().__init__(material, settings)
        frames = material.frames
        self.fitted = OneShotModel(
            material.training,
            settings.gaussians,
            frames.mean_color(),
            len(frames),
            material.seed,
            material.device,
        )
        self.clip = TrainingClip(
            material.training, frames.indices, self.fitted.model.rigs, material.device
        )
        self._perceptual = FilterBankLoss()

    def parameters(self) -> dict[str, torch.Tensor]:
        """See `Recipe`."""
        return self.fitted.parameters()

    def rates(self) -> dict[str, float]:
        """See `Recipe`."""
        settings = self.settings
        by_kind = {"identity": settings.identity_rate, "bias": settings.bias_rate}
        return {
            name: by_kind.get(name.partition(".")[0], settings.color_rate)
            for name in self.parameters()
        }

    def rate(self, name: str, fraction: float) -> float:
        """See `Recipe`."""
        if self.settings.decay == "geometric":
            return super().rate(name, fraction)
        halvings = sum(fraction >= share for share in HALVED_AFTER)
        return self.rates()[name] * 0.5**halvings

    def draw(self, batch: Batch) -> Drawing:
        """See `Recipe`."""
        training = self.material.training
        drawn = self.fitted.model.draw_frames(
            self.clip, batch.rows, training.width, training.height, refine=True
        )
        return Drawing(self.fitted.colored(drawn.image, drawn.coverage), drawn.coverage)

    def loss(self, batch: Batch, drawing: Drawing, weights: torch.Tensor) -> torch.Tensor:
        """See `Recipe`."""
        settings = self.settings
        total = settings.reconstruction * super().loss(batch, drawing, weights)
        if settings.perceptual:
            distance = self._perceptual(drawing.image, batch.images, weights)
            total = total + settings.perceptual * distance
        if settings.mask:
            # Outside, the mask may be what covers the hand: it counts as little as in colours.
            coverage = drawing.coverage[..., 0]
            total = total + settings.mask * silhouette(coverage * weights, batch.masks * weights)
        squares = [bias.square().mean() for bias in self.fitted.plane_bias.values()]
        return total + settings.bias * torch.stack(squares).mean()

    def avatar(self, steps: int) -> Avatar:
        """See `Recipe`."""
        return OneShotAvatar(self.fitted, steps)
