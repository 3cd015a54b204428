"""Weights of frames and pixels, and the images that a drawing is compared with."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from hwp_bench.methods.contract import TrainingCapture
from wildghand.fitting.parallel import SINGLE_PROCESS, World
from wildghand.gaussians.frame_table import FrameTable, soft_weights, upload
from wildghand.gaussians.training import TrainingFrames
from wildghand.model.model import RenderedFrames
from wildghand.model.settings import WildGHandSettings
from wildghand.pao.pao import PerturbationAwareWeights, binary_weights
from wildghand.pao.regions import ClipRegions, Regions
from wildghand.pao.regions.superpixels import RegionCache, Superpixels
from wildghand.pao.robust import blended_residual, residual_weights, running_median
from wildghand.prepass import FrameAssessment, PrepassInput, judge_frames


@dataclass(frozen=True, eq=False)
class FrameTarget:
    """The images that the drawing of B frames is compared with, and how much each pixel counts."""

    #: (B, H, W, 3) sRGB over black outside the mask.
    image: Tensor
    #: (B, H, W) estimated coverage of the visible hand.
    hand: Tensor
    #: (B, H, W) weight of each pixel within its frame.
    weights: Tensor


def assess_frames(
    training: TrainingCapture, frames: TrainingFrames, settings: WildGHandSettings
) -> FrameAssessment | None:
    """Run the pre-pass on the frames that are fitted; None where the settings have none."""
    if not settings.prepass.enabled:
        return None
    return judge_frames(
        PrepassInput(
            indices=frames.indices,
            images=np.asarray(frames.images),
            masks=np.asarray(frames.masks),
            hands=training.hands,
            cameras=training.cameras,
            templates={side: training.template(side) for side in training.sides},
        ),
        settings.prepass,
    )


class Weighting:
    """Weights of frames and pixels, by the settings' components.

    Without PAO a pixel counts as the estimated mask says. The variants of PAO: with `judged` the
    canonical hand learns less from frames that the pre-pass finds perturbed (`shares`), and pixels
    that it finds covered count less, or, later in a `robust` fit, pixels with large residuals;
    with `paper` the paper's equations weigh regions; with `binary` the mask is cut at a half.

    Args:
        frames: the R frames that are fitted.
        hands: one or two.
        assessment: of these frames by the pre-pass; None without it.
        settings: which components are on.
        device: where the tensors live.

    Attributes:
        clean: (R,) probability that a frame is clean; ones without the pre-pass.
        drop_probability: (R,) chance that a frame's biases are left out.
        frame_weights: (R,) how much the canonical hand learns from each frame; ones without the
            pre-pass or without PAO.
        pao: the paper's weights, whose thresholds are learnt.
        median: running median of the residuals in a robust fit; None before the first.
    """

    def __init__(
        self,
        frames: TrainingFrames,
        hands: int,
        assessment: FrameAssessment | None,
        settings: WildGHandSettings,
        device: torch.device,
    ) -> None:
        count, pao = len(frames), settings.pao
        self.frames, self.settings, self.device = frames, settings, device
        self.clean = torch.ones(count)
        self.drop_probability = torch.full((count,), settings.dpd.omega_dropout)
        self.frame_weights = torch.ones(count, device=device)
        self.pao = PerturbationAwareWeights(pao, hands).to(device)
        self.median: float | Tensor | None = None
        self._refine_pose = torch.zeros(count, dtype=torch.bool)
        self._weighs_frames = False
        self._pixel_weights: Tensor | None = None
        self._regions: ClipRegions | None = None
        if assessment is not None:
            self._follow(assessment)
        if pao.robust or (pao.enabled and pao.variant == "paper"):
            regions = RegionCache().clip(frames.images.numpy(), Superpixels())
            self._regions = ClipRegions(regions, device)
        self._images, self._hands = frames.images_on(device), frames.masks_on(device)
        size = 4 * frames.masks[0].numel()
        self._fixed = FrameTable(self._fixed_weights, count, size, device)

    @property
    def saved_median(self) -> float | None:
        """`median` as a number; it may wait for the device."""
        return None if self.median is None else float(self.median)

    def moves(self, rows: Tensor) -> bool:
        """Whether the pose of any frame of a batch is refined."""
        return self.settings.heads.frame_poses and bool(self._refine_pose[rows].any())

    def shares(self, rows: Tensor) -> Tensor | None:
        """How much the canonical hand learns from each frame of a batch, (B,); None: all."""
        if not self._weighs_frames:
            return None
        return self.frame_weights[upload(rows, self.device)]

    def __call__(
        self, rows: Tensor, drawing: RenderedFrames, fraction: float, world: World = SINGLE_PROCESS
    ) -> FrameTarget:
        """Return what a batch, or this process's part of it, is compared with.

        Where weights compare the frames of a batch, all processes weigh all of it.

        Args:
            rows: (B,) int64, which of the R frames are in the batch.
            drawing: of this process's part of them.
            fraction: share of the budget that is used up.
            world: the processes.
        """
        mine = rows[world.shard(len(rows))]
        hand, image = self._hands(mine), self._images(mine)
        pao = self.settings.pao
        if pao.enabled and pao.variant == "paper":
            weights = self._paper_weights(rows, image, drawing, world)
        elif pao.robust and fraction >= pao.robust_start:
            weights = self._soft(hand) * self._robust_weights(rows, image, drawing, world)
        else:
            weights = self._fixed(mine)
        return FrameTarget(image, hand, weights)

    def _soft(self, hand: Tensor) -> Tensor:
        return soft_weights(hand, self.settings.terms.outside_weight)

    def _fixed_weights(self, rows: Tensor) -> Tensor:
        """(B, H, W) weights that do not follow from the drawing."""
        hand, pao = self._hands(rows), self.settings.pao
        if pao.enabled and pao.variant == "binary":
            return binary_weights(hand, pao.binary_outside)
        if self._pixel_weights is None:
            return self._soft(hand)
        return self._soft(hand) * upload(self._pixel_weights[rows], self.device).float() / 255.0

    def _follow(self, assessment: FrameAssessment) -> None:
        """Take from the pre-pass what the components use."""
        self.clean = torch.from_numpy(assessment.clean).float()
        self.drop_probability = torch.from_numpy(assessment.omega_dropout).float()
        self._refine_pose = torch.from_numpy(assessment.refine_pose)
        if self.settings.pao.enabled and self.settings.pao.variant == "judged":
            self._weighs_frames = True
            weights = torch.from_numpy(assessment.frame_weights).float()
            self.frame_weights = weights.to(self.device)
            self._pixel_weights = torch.from_numpy(assessment.pixel_weights)

    def _paper_weights(
        self, rows: Tensor, image: Tensor, drawing: RenderedFrames, world: World
    ) -> Tensor:
        """The paper's equations on all frames of the batch; this process's part of the weights."""
        error, omega = _error(image, drawing), world.gather(drawing.omega)
        found = self.pao(world.gather(error), self._batch_regions(rows), self._hands(rows), omega)
        return found.weights[world.shard(len(rows))]

    def _robust_weights(
        self, rows: Tensor, image: Tensor, drawing: RenderedFrames, world: World
    ) -> Tensor:
        """Weights from the residuals of all frames of the batch; this process's part of them."""
        hands = self._hands(rows)
        error = world.gather(_error(image, drawing))
        residual = blended_residual(error, self._batch_regions(rows), hands)
        self.median = running_median(self.median, residual, hands)
        return residual_weights(residual[world.shard(len(rows))], self.median)

    def _batch_regions(self, rows: Tensor) -> Regions:
        assert self._regions is not None
        return self._regions(rows)


def _error(image: Tensor, drawing: RenderedFrames) -> Tensor:
    """(B, H, W) mean over channels of |drawing - image|, without gradient."""
    return (drawing.image.detach() - image).abs().mean(dim=-1)
