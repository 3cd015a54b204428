"""The plain fit without pixels whose error is among the largest."""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch

from hwp_bench.methods.settings import choice, number
from wildghand.plain.outliers import (
    ErrorHistogram,
    MaskNetwork,
    find_inliers,
    pixel_errors,
    steepness,
    vote_loss,
)
from wildghand.plain.recipe import Batch, Drawing, FitInputs, FitSettings, PlainRecipe, RecipeMethod


def chance_of_all(fraction: float, schedule_steps: float) -> float:
    """The share alpha of pixels that are kept whatever their error; it falls from 1 to 0.

    Args:
        fraction: share of the fit that is done, in [0, 1).
        schedule_steps: steps of the published schedule that the whole fit stands for; 0 gives 0.

    Returns:
        exp(-0.003 floor((1 + step) / 1.5)) at the published schedule's step.

    Source: the code of SpotLessSplats.
    """
    if schedule_steps == 0.0:
        return 0.0
    return math.exp(-3e-3 * math.floor((1.0 + fraction * schedule_steps) / 1.5))


@dataclass(frozen=True)
class TrimmedSettings(FitSettings):
    """Settings of the plain fit, and how outliers are found."""

    #: Who says which pixels are inliers: `rules` (threshold and neighbourhoods), or `vote` (a
    #: network of the image's features that learns from the rules).
    inliers: str = choice("rules", "vote")
    #: Share of the hand's pixels below the threshold, of all recent errors.
    quantile: float = number(0.7, 0.0, 1.0)
    #: Share of the histogram of errors that stays at each step.
    decay: float = number(0.95, 0.0, 1.0)
    #: Whether a pixel counts whose 3 x 3 neighbours are mostly inliers.
    box: bool = True
    #: Whether the inner 8 x 8 px of a patch of 16 x 16 px count if most of the patch does.
    patch: bool = True
    #: Steps of the published schedule that the whole fit stands for; 0 trims from the start.
    schedule_steps: float = number(30_000.0, 0.0, 1e9)
    #: `vote`: share of errors below which a pixel is surely an inlier.
    sure_inlier: float = number(0.5, 0.0, 1.0)
    #: `vote`: share of errors above which a pixel is surely an outlier.
    sure_outlier: float = number(0.9, 0.0, 1.0)
    #: `vote`: Adam step of the network; it does not fall.
    vote_rate: float = 1e-3
    #: `vote`: weight of max |W1| max |W2|, which keeps the network smooth.
    smoothness: float = number(0.5, 0.0, 1e6)


class TrimmedRecipe(PlainRecipe[TrimmedSettings]):
    """See `PlainRecipe`. Weights are multiplied by draws from the chance of being an inlier.

    Attributes:
        histogram: of the errors of recent frames.
        network: what `vote` fits; None with `rules`.
    """

    def __init__(self, material: FitInputs, settings: TrimmedSettings) -> None:
        super().__init__(material, settings)
        self.histogram = ErrorHistogram(settings.decay, material.device)
        voted = settings.inliers == "vote"
        self.network = MaskNetwork(material, places=True) if voted else None
        self._random = torch.Generator().manual_seed(material.seed)
        self._network_loss: torch.Tensor | None = None

    def parameters(self) -> dict[str, torch.Tensor]:
        """The plain fit's, and the network's."""
        return {**super().parameters(), **(self.network.tensors if self.network else {})}

    def rate(self, name: str, fraction: float) -> float:
        """Adam's step of a tensor; that of the network does not fall."""
        if name.startswith("mask."):
            return self.settings.vote_rate
        return super().rate(name, fraction)

    def weights(self, batch: Batch, drawing: Drawing) -> torch.Tensor:
        """The plain fit's, times 0 or 1."""
        weights = super().weights(batch, drawing)
        errors, hand = pixel_errors(drawing.image, batch.images), batch.masks > 0.5
        if self.network:
            inliers = self._vote(self.network, batch, errors, hand)
        else:
            inliers = self._judge(errors, hand, self.settings.quantile).float()
        self.histogram.add(errors[hand])
        alpha = chance_of_all(batch.fraction, self.settings.schedule_steps)
        draws = torch.rand(errors.shape, generator=self._random).to(errors.device)
        return weights * (draws < alpha + (1.0 - alpha) * inliers)

    def loss(self, batch: Batch, drawing: Drawing, weights: torch.Tensor) -> torch.Tensor:
        """The plain fit's, and the network's own."""
        loss = super().loss(batch, drawing, weights)
        return loss if self._network_loss is None else loss + self._network_loss

    def _judge(self, errors: torch.Tensor, hand: torch.Tensor, share: float) -> torch.Tensor:
        settings = self.settings
        threshold = self.histogram.quantile(share)
        return find_inliers(errors, hand, threshold, box=settings.box, patch=settings.patch)

    def _vote(
        self, network: MaskNetwork, batch: Batch, errors: torch.Tensor, hand: torch.Tensor
    ) -> torch.Tensor:
        """Ask the network for the chances of the hand's pixels, and keep what it has to learn."""
        settings = self.settings
        chance = network.chances(batch, hand)
        surely = self._judge(errors, hand, settings.sure_inlier)[hand].float()
        maybe = self._judge(errors, hand, settings.sure_outlier)[hand].float()
        wrong = vote_loss(chance, surely, maybe)
        self._network_loss = wrong + settings.smoothness * steepness(network.tensors)
        found = torch.ones_like(errors)
        found[hand] = chance.detach()
        return found


class TrimmedMethod(RecipeMethod):
    """The plain fit without pixels that fit badly."""

    name = "baselines/trimmed"
    settings_type = TrimmedSettings
    recipe_type = TrimmedRecipe
