"""How much each frame and each pixel of it counts, and what a rendering is compared with."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from hwp_bench.methods.contract import TrainingCapture
from wildghand.fit.parallel import ALONE, World
from wildghand.gaussians.training import TrainingFrames
from wildghand.model.model import Drawing
from wildghand.model.settings import WildGHandSettings
from wildghand.pao.pao import PerturbationAwareWeights
from wildghand.pao.regions import FrameRegions, Regions, stack_regions
from wildghand.pao.regions.cache import RegionCache
from wildghand.pao.regions.superpixels import Superpixels
from wildghand.pao.robust import blended_residual, residual_weights, running_median
from wildghand.prepass import FrameAssessment, PrepassInput, judge_frames


@dataclass(frozen=True, eq=False)
class Target:
    """What the drawing of B frames is compared with."""

    #: (B, H, W, 3) sRGB over black outside the mask.
    image: Tensor
    #: (B, H, W) estimated coverage of the visible hand.
    hand: Tensor
    #: (B, H, W) weight of each pixel within its frame.
    weights: Tensor


class Weighting:
    """Weights of pixels, by the settings' components.

    Without PAO a pixel counts as the estimated mask says. With it, the canonical hand learns
    less from frames that the pre-pass finds perturbed (`shares`), and pixels that it finds
    covered count less; in the mode `paper` the regions' weights of the paper take the place of
    both.

    Args:
        training: what may be seen of the capture.
        frames: the R frames that are fitted.
        settings: which components are on.
        device: where the tensors live.

    Attributes:
        judgement: of the pre-pass; None without it.
        clean: (R,) probability that a frame is clean; ones without the pre-pass.
        drop_probability: (R,) chance that a frame's biases are left out.
        frame_weights: (R,) how much the canonical hand learns from each frame; ones without the
            pre-pass or without PAO.
        pao: the paper's weights, whose thresholds are learnt.
    """

    def __init__(
        self,
        training: TrainingCapture,
        frames: TrainingFrames,
        settings: WildGHandSettings,
        device: torch.device,
    ) -> None:
        count = len(frames)
        self.frames, self.settings, self.device = frames, settings, device
        self.judgement = judge(training, frames, settings) if settings.judges else None
        self.clean = torch.ones(count)
        self.drop_probability = torch.full((count,), settings.omega_dropout)
        self._move = torch.zeros(count, dtype=torch.bool)
        self.frame_weights = torch.ones(count, device=device)
        self._initial: Tensor | None = None
        if self.judgement is not None:
            self.clean = torch.from_numpy(self.judgement.clean).float()
            self.drop_probability = torch.from_numpy(self.judgement.omega_dropout).float()
            self._move = torch.from_numpy(self.judgement.refine_pose)
            if settings.weighs_frames:
                weights = torch.from_numpy(self.judgement.frame_weights).float()
                self.frame_weights = weights.to(device)
                self._initial = torch.from_numpy(self.judgement.pixel_weights)
        self.pao = PerturbationAwareWeights(settings.weights_of(len(training.sides))).to(device)
        self._regions: list[FrameRegions] | None = None
        if settings.uses_regions:
            self._regions = RegionCache().clip(frames.images.numpy(), Superpixels())
        self.median: float | None = None

    def moves(self, rows: Tensor) -> bool:
        """Whether the pose of any frame of a batch is refined."""
        return self.settings.moves_poses and bool(self._move[rows].any())

    def shares(self, rows: Tensor) -> Tensor | None:
        """How much the canonical hand learns from each frame of a batch, (B,); None: all."""
        if self.judgement is None or not self.settings.weighs_frames:
            return None
        return self.frame_weights[rows]

    def __call__(
        self, rows: Tensor, drawing: Drawing, fraction: float, world: World = ALONE
    ) -> Target:
        """Say what a batch, or this process's part of it, is compared with.

        Where weights compare the frames of a batch, all processes weigh all of it.

        Args:
            rows: (B,) int64, which of the R frames are in the batch.
            drawing: of this process's part of them.
            fraction: share of the budget that is used up.
            world: the processes.
        """
        settings = self.settings
        part = world.part(len(rows))
        whole = self.frames.masks[rows].to(self.device).float() / 255.0
        hand, mine = whole[part], rows[part]
        image = self.frames.images[mine].to(self.device).float() / 255.0 * hand[..., None]
        outside = settings.outside_weight
        plain = outside + (1.0 - outside) * hand
        if not settings.pao or settings.binary_mask:
            return Target(image, hand, (hand > 0.5).float() if settings.binary_mask else plain)
        error = (drawing.image.detach() - image).abs().mean(dim=-1)
        if not settings.additions:
            omega = world.gather(drawing.omega)
            found = self.pao(world.gather(error), self._batch_regions(rows), whole, omega)
            return Target(image, hand, found.weights[part])
        weights = plain
        if settings.robust and fraction >= settings.robust_start:
            residual = blended_residual(world.gather(error), self._batch_regions(rows), whole)
            self.median = running_median(self.median, residual, whole)
            weights = weights * residual_weights(residual[part], self.median)
        elif self._initial is not None:
            weights = weights * self._initial[mine].to(self.device).float() / 255.0
        return Target(image, hand, weights)

    def _batch_regions(self, rows: Tensor) -> Regions:
        assert self._regions is not None
        return stack_regions([self._regions[row] for row in rows.tolist()], self.device)


def judge(
    training: TrainingCapture, frames: TrainingFrames, settings: WildGHandSettings
) -> FrameAssessment:
    """Run the pre-pass on the frames that are fitted."""
    return judge_frames(
        PrepassInput(
            indices=frames.indices,
            images=np.asarray(frames.images),
            masks=np.asarray(frames.masks),
            hands=training.hands,
            cameras=training.cameras,
            templates={side: training.template(side) for side in training.sides},
        ),
        settings.judge,
    )
