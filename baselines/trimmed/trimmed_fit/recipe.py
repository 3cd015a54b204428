"""The plain fit in which each pixel is kept or left out by its error."""

from __future__ import annotations

import numpy as np
import torch

from trimmed_fit.inliers import ErrorHistogram, chance_of_all, find_inliers, pixel_errors
from trimmed_fit.settings import TrimmedSettings
from trimmed_fit.vote import LOOK, chances, encodings, look_features, make_network, vote_loss
from wildghand.gaussians.training import FrameTable, upload
from wildghand.plain.recipe import Batch, Drawing, Material, PlainRecipe


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
