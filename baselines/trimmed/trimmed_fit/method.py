"""The plain fit without pixels whose error is among the largest."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch

from hwp_bench.methods.settings import choice, number
from trimmed_fit.inliers import (
    LOOK,
    ErrorHistogram,
    chance_of_all,
    chances,
    encodings,
    find_inliers,
    look_features,
    make_network,
    pixel_errors,
    vote_loss,
)
from wildghand.gaussians.training import FrameTable, upload
from wildghand.plain.recipe import Batch, Drawing, FitSettings, Material, PlainRecipe, RecipeMethod


@dataclass(frozen=True)
class TrimmedSettings(FitSettings):
    """Those of the plain fit, and how outliers are found."""

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
    schedule_steps: float = number(3_000.0, 0.0, 1e9)
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
        network: what `vote` fits; empty with `rules`.
    """

    def __init__(self, material: Material, settings: TrimmedSettings) -> None:
        super().__init__(material, settings)
        device = material.device
        self.histogram = ErrorHistogram(settings.decay, device)
        self.network = make_network(material.seed, device) if settings.inliers == "vote" else {}
        self._random = torch.Generator().manual_seed(material.seed)
        frames = material.frames
        size = 4 * LOOK * frames.masks[0].numel()
        self._looks = FrameTable(self._describe, len(frames), size, device)
        self._places = torch.from_numpy(encodings(*frames.masks.shape[1:])).to(device)
        self._network_loss: torch.Tensor | None = None

    def parameters(self) -> dict[str, torch.Tensor]:
        """The plain fit's, and the network's."""
        return {**super().parameters(), **self.network}

    def rate(self, name: str, fraction: float) -> float:
        """Adam's step of a tensor; that of the network does not fall."""
        if name in self.network:
            return self.settings.vote_rate
        return super().rate(name, fraction)

    def weights(self, batch: Batch, drawing: Drawing) -> torch.Tensor:
        """The plain fit's, times 0 or 1."""
        weights = super().weights(batch, drawing)
        errors, hand = pixel_errors(drawing.image, batch.images), batch.masks > 0.5
        if self.network:
            inliers = self._vote(batch, errors, hand)
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

    def _vote(self, batch: Batch, errors: torch.Tensor, hand: torch.Tensor) -> torch.Tensor:
        """Ask the network for the chances of the hand's pixels, and keep what it has to learn."""
        settings = self.settings
        places = self._places.expand(*hand.shape, -1)
        features = torch.cat((self._looks(batch.rows)[hand], places[hand]), dim=-1)
        chance = chances(features, self.network)
        surely = self._judge(errors, hand, settings.sure_inlier)[hand].float()
        maybe = self._judge(errors, hand, settings.sure_outlier)[hand].float()
        self._network_loss = vote_loss(chance, surely, maybe, self.network, settings.smoothness)
        found = torch.ones_like(errors)
        found[hand] = chance.detach()
        return found

    def _describe(self, rows: torch.Tensor) -> torch.Tensor:
        """The looks of the pixels of some frames, (B, H, W, LOOK)."""
        images = self.material.frames.images[rows].numpy()
        described = torch.from_numpy(np.stack([look_features(image) for image in images]))
        return upload(described, self.material.device)


class TrimmedMethod(RecipeMethod):
    """The plain fit without pixels that fit badly."""

    name = "baselines/trimmed"
    settings_type = TrimmedSettings
    recipe_type = TrimmedRecipe
