"""The plain fit under a hard and a soft mask in turn, held to its own moving average."""

from __future__ import annotations

from dataclasses import dataclass

import torch

from hwp_bench.methods.settings import number
from wildghand.pao.regions import ClipRegions
from wildghand.pao.segmenters import Superpixels
from wildghand.plain.outliers import patch_likeness, pixel_errors
from wildghand.plain.recipe import Batch, Drawing, FitInputs, FitSettings, PlainRecipe, RecipeMethod

#: Edge of the patches that are compared, px.
PATCH = 5


@dataclass(frozen=True)
class ComplementaryMasksSettings(FitSettings):
    """Settings of the plain fit, and how the two masks and the two models act."""

    #: Share of the moving average that stays at each step.
    teacher_decay: float = number(0.8, 0.0, 1.0)
    #: Weight of the mean difference between the model's and the average's images.
    consistency: float = number(0.1, 0.0, 1e6)
    #: Share of the fit before the average counts and the soft mask learns.
    warm_up: float = number(1 / 30, 0.0, 1.0)
    #: By how much a frame's soft mask moves to what it learns, at each visit.
    soft_rate: float = number(0.5, 0.0, 1.0)
    #: Superpixels of a frame, about; the hard mask leaves out whole ones.
    superpixels: int = number(60, 1, 10_000)
    #: Share of the hand's pixels whose error is high; of unlike patches it is twice as many.
    high_share: float = number(0.02, 0.0, 0.5)


def find_hard(
    errors: torch.Tensor,
    unlikeness: torch.Tensor,
    hand: torch.Tensor,
    regions: torch.Tensor,
    high_share: float,
) -> torch.Tensor:
    """The hard mask: superpixels with more than their share of high errors are left out.

    A pixel is high whose error and whose unlikeness are both among the frame's largest. A
    superpixel is left out where more of its pixels are high than of the whole hand's.

    Args:
        errors: (H, W) not negative.
        unlikeness: (H, W) of the patches around pixels.
        hand: (H, W) bool, the pixels that are judged.
        regions: (H, W) int64, the number of each pixel's superpixel.
        high_share: of the pixels by their errors; by their unlikeness it is twice as many.

    Returns:
        (H, W) bool, the pixels that are kept; all outside the hand.

    Source: Li et al., "Asymmetric Dual 3DGS", and its code.
    """
    judged = regions[hand]
    if not len(judged):
        return torch.ones_like(hand)
    bad, odd = errors[hand], unlikeness[hand]
    high = (bad > bad.quantile(1.0 - high_share)) & (odd > odd.quantile(1.0 - 2.0 * high_share))
    size = torch.bincount(judged)
    share = torch.bincount(judged, weights=high.float()) / size.clamp(min=1)
    kept = torch.ones_like(hand)
    kept[hand] = share[judged] <= high.float().mean()
    return kept


def soft_target(unlikeness: torch.Tensor, hand: torch.Tensor) -> torch.Tensor:
    """Goal of the soft mask: 1 at the hand's most alike pixel, 0 at the least, (H, W).

    Source: the code of Li et al., "Asymmetric Dual 3DGS".
    """
    target, found = torch.ones_like(unlikeness), unlikeness[hand]
    if len(found):
        low, high = found.min(), found.max()
        target[hand] = 1.0 - (found - low) / (high - low + 1e-8)
    return target


class ComplementaryMasksRecipe(PlainRecipe[ComplementaryMasksSettings]):
    """See `PlainRecipe`. Steps take the soft and the hard mask in turn.

    Attributes:
        teacher: the moving average of the model.
        soft: (R, H, W) the soft mask of each frame, in [0, 1].
        regions: the superpixels of each frame.
    """

    def __init__(self, material: FitInputs, settings: ComplementaryMasksSettings) -> None:
        super().__init__(material, settings)
        frames, segmenter = material.frames, Superpixels(settings.superpixels)
        self.teacher = self.model.snapshot()
        self.soft = torch.ones(frames.masks.shape, device=material.device)
        self.regions = ClipRegions(
            [segmenter.regions(image) for image in frames.images.numpy()], material.device
        )

    def weights(self, batch: Batch, drawing: Drawing) -> torch.Tensor:
        """The plain fit's, times the mask whose turn it is."""
        weights = super().weights(batch, drawing)
        hand = batch.masks > 0.5
        unlikeness = 1.0 - patch_likeness(drawing.image, batch.images, PATCH)
        if batch.step % 2:
            errors = pixel_errors(drawing.image, batch.images)
            found = zip(errors, unlikeness, hand, self.regions(batch.rows).index, strict=True)
            share = self.settings.high_share
            return weights * torch.stack([find_hard(*one, share) for one in found])
        rows = batch.rows.to(self.soft.device)
        if batch.fraction >= self.settings.warm_up:
            pairs = zip(unlikeness, hand, strict=True)
            target = torch.stack([soft_target(*pair) for pair in pairs])
            self.soft[rows] = torch.lerp(self.soft[rows], target, self.settings.soft_rate)
        return weights * self.soft[rows]

    def loss(self, batch: Batch, drawing: Drawing, weights: torch.Tensor) -> torch.Tensor:
        """The plain fit's, and the difference to what the average draws, wherever they differ."""
        loss = super().loss(batch, drawing, weights)
        settings = self.settings
        if batch.fraction < settings.warm_up or settings.consistency == 0.0:
            return loss
        training, clip, rows = self.material.training, self.clip, batch.rows
        with torch.no_grad():
            agreed, _ = self.teacher.render(
                clip.poses(rows),
                clip.viewmats[rows],
                clip.Ks[rows],
                training.width,
                training.height,
            )
        return loss + settings.consistency * (drawing.image - agreed).abs().mean()

    @torch.no_grad()
    def move_back(self, batch: Batch) -> None:
        """The plain fit's, and the step of the average."""
        super().move_back(batch)
        now, share = self.model.parameters(), 1.0 - self.settings.teacher_decay
        for name, average in self.teacher.parameters().items():
            average.lerp_(now[name], share)


class ComplementaryMasksMethod(RecipeMethod):
    """The plain fit under two masks in turn, held to its own average."""

    name = "baselines/complementary-masks"
    settings_type = ComplementaryMasksSettings
    recipe_type = ComplementaryMasksRecipe
