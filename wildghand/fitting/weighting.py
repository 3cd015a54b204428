"""Weights of frames and pixels, and the images that a drawing is compared with."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from torch import Tensor

from hwp_bench.hands import HandTemplate
from hwp_bench.methods.contract import TrainingCapture
from wildghand.dpd.pay_back import PayBack
from wildghand.fitting.hidden_skin import hidden_skin
from wildghand.fitting.networks import choose_segmenter
from wildghand.fitting.parallel import SINGLE_PROCESS, World
from wildghand.gaussians.frame_table import FrameTable, shares_of_255, soft_weights, upload
from wildghand.gaussians.training import TrainingFrames
from wildghand.model.frames import RenderedFrames
from wildghand.model.settings import WildGHandSettings
from wildghand.pao.pao import PerturbationAwareWeights, binary_weights
from wildghand.pao.place_errors import PlaceErrors
from wildghand.pao.regions import ClipRegions, FrameRegions
from wildghand.pao.regions.superpixels import RegionCache
from wildghand.pao.running_median import running_median
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
    #: (B,) means of PAO's weights, which the loss rewards; None without regions.
    sizes: Tensor | None = None


def weighs_by_place(settings: WildGHandSettings) -> bool:
    """Whether PAO counts the errors of regions in those of their places."""
    pao = settings.pao
    return pao.enabled and pao.variant != "binary" and pao.errors == "place"


def needs_places(settings: WildGHandSettings) -> bool:
    """Whether anything asks for the place of the skin at each pixel."""
    return weighs_by_place(settings) or settings.terms.leave_hidden


def assess_frames(
    training: TrainingCapture,
    frames: TrainingFrames,
    templates: Mapping[str, HandTemplate],
    settings: WildGHandSettings,
    judges: TrainingFrames | None = None,
) -> FrameAssessment | None:
    """Run the pre-pass on the frames that are fitted; None where the settings have none.

    Args:
        training: their parameters and cameras.
        frames: the frames.
        templates: of the person's hands, by side.
        settings: of the fit.
        judges: validation frames, which are clean.
    """
    if not settings.prepass.enabled:
        return None

    def given(each: TrainingFrames) -> PrepassInput:
        return PrepassInput(
            indices=each.indices,
            images=np.asarray(each.images),
            masks=np.asarray(each.masks),
            hands=training.hands,
            cameras=training.cameras,
            templates=templates,
        )

    clean = given(judges) if judges is not None and settings.prepass.validated else None
    return judge_frames(given(frames), settings.prepass, clean)


class Weighting:
    """Weights of frames and pixels, by the settings' components.

    PAO weighs regions by the paper's equations, and frames by the temporal weights of DPD; its
    variant `binary` cuts the mask at a half. The pre-pass lowers pixels that it finds covered, with
    PAO and without. Without both a pixel counts as the estimated mask says.

    Args:
        frames: the R frames that are fitted.
        hands: one or two.
        assessment: of these frames by the pre-pass; None without it.
        settings: which components are on.
        device: where the tensors live.
        places: R times (H, W) uint16, the place of the skin at each pixel; only where
            `needs_places` says so.

    Attributes:
        clean: (R,) probability that a frame is clean; ones without the pre-pass.
        frame_weights: (R,) by the pre-pass, from its floor to 1; ones without it. DPD's temporal
            weights start from them.
        gains: (R,) gain on the linear light of each frame, mean over channels; ones without the
            pre-pass.
        drop_probability: (R,) chance that a frame's biases are left out.
        pao: the paper's weights, whose thresholds are learnt.
        median: running median of the regions' errors; None before the first, and where PAO does
            not count in it.
        places: ordinary errors by place; None where PAO does not count in them.
        tolerance: in [0, 1), how far a mismatch that all frames share lifts PAO's weights towards
            1: those of regions, and how much a frame teaches.
        lifts: (R,) in [0, 1], how far the weights of each frame's regions are lifted: by the
            tolerance, and by the probability that the frame is clean.
        pay_back: what the frames' biases explain; None where nothing follows from it.
    """

    def __init__(
        self,
        frames: TrainingFrames,
        hands: int,
        assessment: FrameAssessment | None,
        settings: WildGHandSettings,
        device: torch.device,
        places: Sequence[np.ndarray] = (),
    ) -> None:
        count, pao = len(frames), settings.pao
        self.frames, self.settings, self.device = frames, settings, device
        self.clean = torch.ones(count)
        self.drop_probability = torch.full((count,), settings.dpd.omega_dropout)
        self.frame_weights = torch.ones(count)
        self.gains = torch.ones(count, dtype=torch.float64)
        self.pao = PerturbationAwareWeights(pao, hands).to(device)
        self.median: float | Tensor | None = None
        self._refine_pose = torch.zeros(count, dtype=torch.bool)
        self.tolerance = 0.0
        self.lifts = torch.zeros(count)
        self._weighs_regions = pao.enabled and pao.variant != "binary"
        self._pixel_weights: Tensor | None = None
        self._regions: ClipRegions | None = None
        if assessment is not None:
            self._follow(assessment)
        if not settings.dpd.biases:
            self.drop_probability = torch.ones(count)
        # Without DPD there is no omega.
        self._teaches = self._weighs_regions and pao.temporal == "teaching" and settings.dpd.enabled
        tolerance = settings.dpd.pay_back if self._teaches else 0.0
        self.pay_back = PayBack(self.clean.to(device), tolerance) if tolerance else None
        if self._weighs_regions:
            segmenter = choose_segmenter(settings.pao.regions, device)
            regions = RegionCache().clip(frames.images.numpy(), segmenter)
            self._regions = ClipRegions(regions, device)
        self.places: PlaceErrors | None = None
        if weighs_by_place(settings):
            labels = [FrameRegions(one) for one in places]
            numbers = 1 + max(int(one.max()) for one in places)
            self.places = PlaceErrors(ClipRegions(labels, device), self.clean.to(device), numbers)
        self._images, self._hands = frames.images_on(device), frames.masks_on(device)
        size = 4 * frames.masks[0].numel()
        self._fixed = FrameTable(self._fixed_weights, count, size, device)
        self._hidden: FrameTable | None = None
        if settings.terms.leave_hidden:
            hidden = torch.from_numpy(hidden_skin(places, frames.masks.numpy()))
            self._hidden = FrameTable(
                lambda rows: upload(hidden[rows], device), count, size // 4, device
            )

    def state_dict(self) -> dict[str, Any]:
        """What steps change, for `load_state_dict`; it may wait for the device."""
        return {
            "thresholds": self.pao.state_dict(),
            "median": None if self.median is None else float(self.median),
            "ordinary": None if self.places is None else self.places.ordinary.clone(),
            "residuals": None if self.pay_back is None else self.pay_back.residuals.clone(),
        }

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Go on from a saved state."""
        self.pao.load_state_dict(state["thresholds"])
        self.median = None if state["median"] is None else float(state["median"])
        if self.places is not None and state.get("ordinary") is not None:
            self.places.ordinary.copy_(state["ordinary"])
        if self.pay_back is not None and state.get("residuals") is not None:
            self.pay_back.residuals.copy_(state["residuals"])

    def visible(self, rows: Tensor) -> Tensor:
        """How much each pixel of some frames says of the hand, (B, H, W) in [0, 1].

        Args:
            rows: (B,) int64, which of the R frames; on the CPU.
        """
        hand = self._hands(rows)
        if self._pixel_weights is not None:
            hand = hand * self._uncovered(rows)
        return hand * self.frame_weights[rows].to(hand)[:, None, None]

    def moves(self, rows: Tensor) -> bool:
        """Whether the pose of any frame of a batch is refined."""
        return self.settings.prepass.frame_poses and bool(self._refine_pose[rows].any())

    def shares(self, rows: Tensor, omega: Tensor) -> Tensor | None:
        """How much the canonical hand learns from each frame of a batch.

        Args:
            rows: (B,) int64, which of the R frames; on the CPU.
            omega: (B,) their temporal weights, without gradient.

        Returns:
            (B,) in (0, 1]; None: everything.
        """
        if not self._teaches:
            return None
        shares = self.pao.temporal_factor(omega)
        shares = shares + self.tolerance * (1.0 - shares)
        if self.pay_back is not None:
            shares = torch.maximum(shares, self.pay_back.shares(rows))
        return shares

    def __call__(
        self, rows: Tensor, drawing: RenderedFrames, world: World = SINGLE_PROCESS
    ) -> FrameTarget:
        """Return what a batch, or this process's part of it, is compared with.

        Where weights compare the frames of a batch, all processes weigh all of it.

        Args:
            rows: (B,) int64, which of the R frames are in the batch.
            drawing: of this process's part of them.
            world: the processes.
        """
        mine = rows[world.shard(len(rows))]
        hand, image = self._hands(mine), self._images(mine)
        if self._hidden is not None:
            # Compared with itself, a pixel asks for nothing, in the windows of SSIM neither.
            image = torch.where(self._hidden(mine)[..., None], drawing.image.detach(), image)
        if not self._weighs_regions:
            return FrameTarget(image, hand, self._fixed(mine))
        error = world.gather(_mean_error(drawing.image, image))
        if self.pay_back is not None:
            self.pay_back.watch(rows, error, self._fixed(rows) * self._hands(rows))
        weights, sizes = self._region_weights(rows, error, drawing, world)
        return FrameTarget(image, hand, weights, sizes)

    def _region_weights(
        self, rows: Tensor, error: Tensor, drawing: RenderedFrames, world: World
    ) -> tuple[Tensor, Tensor]:
        """The paper's equations on all frames of the batch.

        Returns:
            This process's part of the weights, and (B,) their means.
        """
        assert self._regions is not None
        regions, hands = self._regions(rows), self._hands(rows)
        part = world.shard(len(rows))
        omega = world.gather(drawing.omega)
        if world.size > 1:  # what is gathered has no gradient
            omega = torch.cat([omega[: part.start], drawing.omega, omega[part.stop :]])
        expected = None
        if self.places is not None and self.median is not None:
            expected = self.places.expected(rows, self.median)
        found = self.pao(error, regions, hands, omega, self.median, expected)
        if self.settings.pao.errors in ("median", "place"):
            self.median = running_median(self.median, found.mean_errors, found.shares > 0.0)
        if self.places is not None and self.median is not None:
            self.places.watch(rows, error, hands > 0.5, self.median)
        weights = found.weights[part]
        lifts = self.lifts[rows[part]]
        if bool((lifts > 0.0).any()):
            share = upload(lifts, self.device)[:, None, None].to(weights)
            weights = torch.lerp(weights, hands[part].to(weights), share)
        if self.settings.pao.variant == "scaled":
            weights = weights + self.settings.terms.outside_weight * (1.0 - hands[part])
        if self._pixel_weights is not None:
            weights = weights * self._uncovered(rows[part])
        return weights, found.sizes[part]

    def _fixed_weights(self, rows: Tensor) -> Tensor:
        """(B, H, W) weights that do not follow from the drawing."""
        hand, pao = self._hands(rows), self.settings.pao
        if pao.enabled and pao.variant == "binary":
            weights = binary_weights(hand, pao.binary_outside)
        else:
            weights = soft_weights(hand, self.settings.terms.outside_weight)
        return weights if self._pixel_weights is None else weights * self._uncovered(rows)

    def _uncovered(self, rows: Tensor) -> Tensor:
        """(B, H, W) in [0, 1] what the pre-pass leaves of the pixels."""
        assert self._pixel_weights is not None
        return shares_of_255(self._pixel_weights[rows], self.device)

    def _follow(self, assessment: FrameAssessment) -> None:
        """Take from the pre-pass what the components use."""
        self.clean = torch.from_numpy(assessment.clean).float()
        self.drop_probability = torch.from_numpy(assessment.omega_dropout).float()
        self._refine_pose = torch.from_numpy(assessment.refine_pose)
        self.frame_weights = torch.from_numpy(assessment.frame_weights).float()
        self._pixel_weights = torch.from_numpy(assessment.pixel_weights)
        self.gains = torch.from_numpy(np.exp(assessment.log_gains.mean(axis=1)))
        if weighs_by_place(self.settings) and self.settings.pao.variant == "scaled":
            floor = self.settings.prepass.misplacement_floor
            shared = self.settings.pao.mismatch * assessment.shared_mismatch(floor)
            self.tolerance = shared**2 / (1.0 + shared**2)
            spared = self.clean if self.settings.pao.spare_clean else torch.zeros_like(self.clean)
            self.lifts = 1.0 - (1.0 - self.tolerance) * (1.0 - spared)


def _mean_error(drawing: Tensor, image: Tensor) -> Tensor:
    """(B, H, W) mean over channels of |drawing - image|, without gradient."""
    # A product takes a third of the time of a mean over three numbers.
    thirds = image.new_full((image.shape[-1],), 1.0 / image.shape[-1])
    return (drawing.detach() - image).abs() @ thirds
