"""How much each pixel and each frame counts: by the mask alone, or by PAO."""

from __future__ import annotations

import copy
from collections.abc import Iterable, Mapping
from dataclasses import replace
from typing import Any

import torch
from torch import Tensor

from hwp_bench.methods.settings import source_path
from wildghand.fitting.fit import Component, DrawOptions, Fit, FrameTarget, StepBatch
from wildghand.fitting.judging import Prepass
from wildghand.fitting.parallel import SINGLE_PROCESS
from wildghand.gaussians.training import FrameTable, soft_weights, upload
from wildghand.model import terms
from wildghand.model.frames import RenderedFrames
from wildghand.pao.pao import PerturbationAwareWeights, PlaceErrors, binary_weights, running_median
from wildghand.pao.regions import ClipRegions, FrameRegions
from wildghand.pao.sam import open_sam
from wildghand.pao.segmenters import RegionCache, Segmenter, Superpixels


class MaskWeights(Component):
    """A pixel counts as the mask says: softly, or cut at a half (`pao.variant` `binary`)."""

    def before(self, fit: Fit) -> None:
        """Make the weights of all frames, once."""
        settings, masks = fit.settings, fit.data.masks

        def weigh(rows: Tensor) -> Tensor:
            if settings.pao.enabled:
                return binary_weights(masks(rows))
            return soft_weights(masks(rows), settings.terms.outside_weight)

        frames = fit.data.frames
        size = 4 * frames.masks[0].numel()
        self._weights = FrameTable(weigh, len(frames), size, fit.device)

    def compare(
        self, fit: Fit, batch: StepBatch, drawing: RenderedFrames, target: FrameTarget
    ) -> FrameTarget:
        """Weigh by the masks."""
        return replace(target, weights=self._weights(batch.mine) * target.weights)


class Pao(Component):
    """Regions are weighed by the paper's equations, and frames by the temporal weights of DPD.

    Attributes:
        weights: the paper's, whose thresholds are learnt.
        median: running median of the regions' errors; None before the first, and where it does not
            count.
        places: ordinary errors by place; None where they do not count.
        tolerance: in [0, 1), how far a mismatch that all frames share lifts weights towards 1:
            those of regions, and how much a frame teaches.
        lifts: (R,) in [0, 1], how far the weights of each frame's regions are lifted: by the
            tolerance, and by the probability that the frame is clean.
    """

    weights: PerturbationAwareWeights

    def before(self, fit: Fit) -> None:
        """Cut the frames into regions."""
        data, settings, device = fit.data, fit.settings, fit.device
        pao, count, clean = settings.pao, len(data.frames), data.judgement.clean
        self.weights = PerturbationAwareWeights(pao.variant, len(data.training.sides)).to(device)
        self._start = copy.deepcopy(self.weights.state_dict())
        self._scaled = pao.variant == "scaled"
        self.median: float | Tensor | None = None
        self.tolerance, self.lifts = 0.0, torch.zeros(count)
        prepass = fit.part(Prepass)
        if prepass is not None and self._scaled:
            floor = settings.prepass.misplacement_floor
            shared = pao.mismatch * prepass.assessment.shared_mismatch(floor)
            self.tolerance = shared**2 / (1.0 + shared**2)
            spared = clean if pao.spare_clean else torch.zeros_like(clean)
            self.lifts = 1.0 - (1.0 - self.tolerance) * (1.0 - spared)
        # Without DPD there is no omega.
        self._teaches = self._scaled and settings.dpd.enabled
        regions = RegionCache().clip(
            data.frames.images.numpy(), choose_segmenter(pao.regions, device)
        )
        self._regions = ClipRegions(regions, device)
        self.places: PlaceErrors | None = None
        if self._scaled:
            labels = [FrameRegions(one) for one in data.places]
            numbers = 1 + max(int(one.max()) for one in data.places)
            self.places = PlaceErrors(ClipRegions(labels, device), clean.to(device), numbers)

    def parameters(self) -> dict[str, Iterable[Tensor]]:
        """The thresholds."""
        return {"thresholds": list(self.weights.parameters())}

    def draws(self, fit: Fit, batch: StepBatch) -> DrawOptions:
        """The canonical hand learns the less from a frame, the more it is perturbed."""
        return {"teach": self.shares} if self._teaches else {}

    def shares(self, omega: Tensor) -> Tensor:
        """How much the canonical hand learns from frames, (B,) in (0, 1].

        Args:
            omega: (B,) their temporal weights, without gradient.
        """
        shares = self.weights.temporal_factor(omega)
        return shares + self.tolerance * (1.0 - shares)

    def compare(
        self, fit: Fit, batch: StepBatch, drawing: RenderedFrames, target: FrameTarget
    ) -> FrameTarget:
        """Weigh by the paper's equations.

        The default compares the frames of a batch, so that all processes weigh all of it.
        """
        if self.weights.variant == "released":
            return self._compare_as_released(fit, batch, drawing, target)
        data = fit.data
        # Frames are looked at by one process alone.
        world = fit.world if batch.stepping else SINGLE_PROCESS
        rows, mine, hands = batch.rows, batch.mine, data.masks(batch.rows)
        error = world.gather(_mean_error(drawing.image, target.image))
        expected = None
        if self.places is not None and self.median is not None:
            expected = self.places.expected(rows, self.median)
        omega = world.gather(drawing.omega.detach())
        found = self.weights(error, self._regions(rows), hands, omega, expected)
        if self.places is not None:
            self.median = running_median(self.median, found.mean_errors, found.shares > 0.0)
            self.places.watch(rows, error, hands > 0.5, self.median)
        weights, lifts = found.weights[batch.part], self.lifts[mine]
        reward = _reward(fit, weights)
        if bool((lifts > 0.0).any()):
            share = upload(lifts, fit.device)[:, None, None].to(weights)
            weights = torch.lerp(weights, target.hand.to(weights), share)
        if self._scaled:
            weights = weights + fit.settings.terms.outside_weight * (1.0 - target.hand)
        return replace(target, weights=weights * target.weights, reward=reward)

    def _compare_as_released(
        self, fit: Fit, batch: StepBatch, drawing: RenderedFrames, target: FrameTarget
    ) -> FrameTarget:
        """Weigh by the authors' code, each process its own frames; black is what is not hand."""
        whole, visible = fit.data.whole_images(batch.mine), target.hand > 0.5
        found = self.weights.released(
            (drawing.image - whole).abs(),
            self._regions(batch.mine),
            visible,
            fit.data.silhouettes(batch.mine),
            drawing.coverage[..., 0],
        )
        weights = found.weights
        image = whole * visible[..., None]
        return replace(
            target, image=image, weights=weights * target.weights, reward=_reward(fit, weights)
        )

    def loss(
        self, fit: Fit, batch: StepBatch, drawing: RenderedFrames, target: FrameTarget
    ) -> Iterable[Tensor]:
        """Keep it from weighing everything with 0."""
        if target.reward is not None:
            yield target.reward

    def forget(self) -> None:
        """Begin again, as before the first step."""
        self.weights.load_state_dict(self._start)
        self.median = None
        if self.places is not None:
            self.places.ordinary.zero_()

    def state_dict(self) -> dict[str, Any]:
        """See `Component`."""
        return {
            "thresholds": self.weights.state_dict(),
            "median": None if self.median is None else float(self.median),
            "ordinary": None if self.places is None else self.places.ordinary.clone(),
        }

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """See `Component`."""
        self.weights.load_state_dict(state["thresholds"])
        self.median = None if state["median"] is None else float(state["median"])
        if self.places is not None:
            self.places.ordinary.copy_(state["ordinary"])


def choose_segmenter(source: str, device: torch.device) -> Segmenter:
    """What cuts frames into regions, as the setting `pao.regions` says."""
    path = source_path(source)
    return Superpixels() if path is None else open_sam(path, str(device))


def _reward(fit: Fit, weights: Tensor) -> Tensor | None:
    """The weighted reward of W (B, H, W), a scalar; None where it has no weight."""
    weight = fit.settings.terms.fixed.weight_reward
    return weight * terms.weight_reward(weights.mean(dim=(1, 2))) if weight else None


def _mean_error(drawing: Tensor, image: Tensor) -> Tensor:
    """(B, H, W) mean over channels of |drawing - image|, without gradient."""
    # A product takes a third of the time of a mean over three numbers.
    thirds = image.new_full((image.shape[-1],), 1.0 / image.shape[-1])
    return (drawing.detach() - image).abs() @ thirds
