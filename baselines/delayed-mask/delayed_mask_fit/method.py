"""The plain fit with a learnt mask that is held towards static at first, from coarse to fine."""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch.nn.functional import avg_pool2d, max_pool2d

from hwp_bench.methods.settings import number
from wildghand.plain.outliers import (
    ErrorHistogram,
    MaskNetwork,
    find_inliers,
    patch_likeness,
    pixel_errors,
    vote_loss,
)
from wildghand.plain.recipe import Batch, Drawing, FitInputs, FitSettings, PlainRecipe, RecipeMethod

#: Share of the histogram of errors that stays at each step.
DECAY = 0.95
#: Shares of the errors below which a pixel is surely static, and above which surely transient.
SURELY, MAYBE = 0.6, 0.8
#: Chance of being static above which a pixel counts.
KEPT = 0.25
#: Edge of the squares over which images are averaged for coarse errors, px.
COARSE = 5
#: Edges of the patches whose likeness counts, first and then, px.
COARSE_PATCH, FINE_PATCH = 9, 5
#: Weights of likeness and errors in what the network learns.
LIKENESS, ERRORS = 0.5, 0.5
#: What Gaussians need to follow a detail: their places, sizes and orientations.
SHAPE = ("offsets", "log_scales", "quats")


@dataclass(frozen=True)
class DelayedMaskSettings(FitSettings):
    """Settings of the plain fit, and how the mask is learnt and delayed."""

    #: Share of the fit before the mask is learnt and pixels are left out.
    mask_from: float = number(1 / 60, 0.0, 1.0)
    #: Share of the fit over which the pull towards static falls to 1/e; 0: there is none.
    release: float = number(1 / 15, 0.0, 1e6)
    #: Weight of the pull towards static at the start.
    pull: float = number(0.5, 0.0, 1e6)
    #: Share of the fit in which the network learns from coarse images.
    coarse_until: float = number(2 / 3, 0.0, 1.0)
    #: Share of the fit in which Gaussians keep their places, sizes and orientations; 1/3 in the
    #: schedule of RobustSplat, whose Gaussians do not grow in number before.
    shape_from: float = number(0.0, 0.0, 1.0)
    #: By how much what is left out grows on all sides, px.
    margin: int = number(3, 0, 64)
    #: Adam step of the network; it does not fall.
    mask_rate: float = 0.03


def box_mean(image: torch.Tensor, edge: int) -> torch.Tensor:
    """The mean of the edge x edge px around each pixel of (B, H, W, C); outside is black."""
    return avg_pool2d(image.movedim(-1, 1), edge, 1, edge // 2).movedim(1, -1)


def static_pull(chance: torch.Tensor, fraction: float, release: float) -> torch.Tensor:
    """exp(-t / release) times the mean of 1 - chance: the pull towards static at a share t.

    Source: Fu et al., "RobustSplat", where it is exp(-i / 2000) at step i of 30,000.
    """
    return (1.0 - chance).mean() * (math.exp(-fraction / release) if release else 0.0)


class DelayedMaskRecipe(PlainRecipe[DelayedMaskSettings]):
    """See `PlainRecipe`. Pixels count that a network takes for static.

    Attributes:
        histogram: of the errors of recent frames.
        network: says which pixels are static.
    """

    def __init__(self, material: FitInputs, settings: DelayedMaskSettings) -> None:
        super().__init__(material, settings)
        self.histogram = ErrorHistogram(DECAY, material.device)
        self.network = MaskNetwork(material, places=False)
        self._network_loss: torch.Tensor | None = None

    def parameters(self) -> dict[str, torch.Tensor]:
        """The plain fit's, and the network's."""
        return {**super().parameters(), **self.network.tensors}

    def rate(self, name: str, fraction: float) -> float:
        """Adam's step of a tensor; 0 for shapes at first, and the same for the network always."""
        if name in self.network.tensors:
            return self.settings.mask_rate
        if name in SHAPE and fraction < self.settings.shape_from:
            return 0.0
        return super().rate(name, fraction)

    def weights(self, batch: Batch, drawing: Drawing) -> torch.Tensor:
        """The plain fit's, and 0 at pixels that the network does not take for static."""
        weights = super().weights(batch, drawing)
        if batch.fraction < self.settings.mask_from:
            return weights
        hand = batch.masks > 0.5
        chance = self.network.chances(batch, hand)
        self._network_loss = self._teach(batch, drawing, chance, hand)
        left_out = torch.zeros_like(weights)
        left_out[hand] = (chance.detach() <= KEPT).float()
        margin = self.settings.margin
        return weights * (1.0 - max_pool2d(left_out[:, None], 2 * margin + 1, 1, margin)[:, 0])

    def loss(self, batch: Batch, drawing: Drawing, weights: torch.Tensor) -> torch.Tensor:
        """The plain fit's, with the gradient of the network's own, which adds nothing to it.

        The network's loss begins within the fit and is larger than the images': a loss that rises
        so much would be taken for a fit that diverges.
        """
        loss, own = super().loss(batch, drawing, weights), self._network_loss
        return loss if own is None else loss + (own - own.detach())

    def _teach(
        self, batch: Batch, drawing: Drawing, chance: torch.Tensor, hand: torch.Tensor
    ) -> torch.Tensor:
        """The loss of the chances (P,) that the network gives the pixels of a batch."""
        settings = self.settings
        coarse = batch.fraction < settings.coarse_until
        image, target = drawing.image.detach(), batch.images
        likeness = patch_likeness(image, target, COARSE_PATCH if coarse else FINE_PATCH)[hand]
        if coarse:
            image, target = box_mean(image, COARSE), box_mean(target, COARSE)
        errors = pixel_errors(image, target)
        thresholds = [self.histogram.quantile(share) for share in (SURELY, MAYBE)]
        self.histogram.add(errors[hand])
        surely, maybe = (
            find_inliers(errors, hand, threshold, box=True, patch=False)[hand].float()
            for threshold in thresholds
        )
        return (
            LIKENESS * (chance - (2.0 * likeness - 1.0).clamp(0.0, 1.0)).abs().mean()
            + ERRORS * vote_loss(chance, surely, maybe)
            + settings.pull * static_pull(chance, batch.fraction, settings.release)
        )


class DelayedMaskMethod(RecipeMethod):
    """The plain fit with a mask that is held towards static at first."""

    name = "baselines/delayed-mask"
    settings_type = DelayedMaskSettings
    recipe_type = DelayedMaskRecipe
