"""The loss of a fit: the weighted reconstruction and the regularisers.

Terms of weight 0 cost nothing.
"""

from __future__ import annotations

from collections.abc import Iterable

import torch
from torch import Tensor, nn

from hwp_bench.base.errors import UsageError
from hwp_bench.methods.settings import source_path
from wildghand.fitting.descent import Features
from wildghand.fitting.fit import Component, Fit, FrameTarget, StepBatch
from wildghand.gaussians.perceptual import FilterBankLoss, Vgg19
from wildghand.gaussians.regularizers import attribute_roughness, off_surface, surface_laplacian
from wildghand.gaussians.training import upload
from wildghand.model import terms
from wildghand.model.frames import RenderedFrames
from wildghand.model.settings import WildGHandSettings


class Reconstruction(Component):
    """The drawing is to look like the frame."""

    def before(self, fit: Fit) -> None:
        """Open the perceptual network, if there is one."""
        self._perceptual = choose_perceptual(fit.settings, fit.device)

    def loss(
        self, fit: Fit, batch: StepBatch, drawing: RenderedFrames, target: FrameTarget
    ) -> Iterable[Tensor]:
        """Weighted L1 and D-SSIM, the perceptual distance, and the silhouette."""
        settings, image = fit.settings.terms, drawing.image
        weights = settings.fixed
        dssim = settings.dssim_share(exact_poses=fit.data.exact_poses)
        yield weights.reconstruction * terms.reconstruction(
            image, target.image, target.weights, dssim
        )
        if self._perceptual is not None:
            found = self._perceptual(image, target.image, target.weights)
            yield settings.perceptual * found
        if weights.silhouette:
            hands = fit.data.silhouettes(batch.mine)
            yield weights.silhouette * terms.silhouette(drawing.coverage, hands)


class Regularisers(Component):
    """Terms that hold the Gaussians of a hand, whatever the frames show."""

    def before(self, fit: Fit) -> None:
        """Make the Laplacians of the surface."""
        weights = fit.settings.terms.fixed
        smooth = (weights.laplacian_offsets, weights.laplacian_scales, weights.laplacian_colors)
        rigs = fit.model.rigs
        self._laplacians = (
            {side: surface_laplacian(rig) for side, rig in rigs.items()} if any(smooth) else {}
        )

    def loss(
        self, fit: Fit, batch: StepBatch, drawing: RenderedFrames, target: FrameTarget
    ) -> Iterable[Tensor]:
        """Biases, shadows, opacities, discs on the skin, and roughness of scales and colours."""
        settings, model = fit.settings.terms, fit.model
        weights, flatness = settings.fixed, 0.0
        if not fit.data.exact_poses:
            flatness = terms.SURFACE_INEXACT
        for side, hand in drawing.hands.items():
            raw = hand.prediction.raw
            if weights.bias and hand.bias_size is not None:
                size = hand.bias_size
                if weights.squared_sums:
                    module = model.biases_of(side)
                    z = module.temporal(upload(batch.mine, fit.device)).z
                    size = module.sum_of_means(raw.concatenate(), z).square().mean()
                yield weights.bias * size
            for weight, values in (
                (weights.shadow, hand.prediction.xi),
                (weights.opacity, hand.opacities),
            ):
                if weight:
                    distance = terms.distance_to_one(values, squared=weights.squared_distances)
                    yield weight * distance
            if settings.surface:
                off = off_surface(
                    raw,
                    model.network.activation,
                    model.rigs[side].spacing,
                    flatness=flatness,
                )
                yield settings.surface * off
            rough = weights.laplacian_scales, weights.laplacian_colors
            if any(rough):
                yield attribute_roughness(self._laplacians[side], raw, *rough)

    def loss_of_features(self, fit: Fit, features: Features) -> Tensor | None:
        """Penalise rough offsets of the template (head iii), and unlike textures of both hands."""
        weights, found = fit.settings.terms.fixed, []
        if weights.laplacian_offsets and fit.settings.heads:
            for side, hand in features.items():
                rough = self._laplacians[side].offsets(hand.template_offsets)
                found.append(weights.laplacian_offsets * rough)
        if weights.cross_hand and len(features) == 2:
            left, right = (features[side].texture for side in ("left", "right"))
            apart = terms.cross_hand(left, right, squared=weights.squared_sums)
            found.append(weights.cross_hand * apart)
        return torch.stack(found).sum() if found else None


def refuse_idle_network(settings: WildGHandSettings) -> None:
    """Refuse a perceptual network whose term has no weight."""
    if source_path(settings.perceptual) is not None and not settings.terms.perceptual:
        raise UsageError(
            "has no effect, since terms.perceptual is 0",
            field="perceptual",
            remedy="Set terms.perceptual too: 0.001 (mode default), 0.1 (mode paper).",
        )


def choose_perceptual(settings: WildGHandSettings, device: torch.device) -> nn.Module | None:
    """The perceptual distance of a fit; None where its weight is 0."""
    if not settings.terms.perceptual:
        return None
    path = source_path(settings.perceptual)
    return FilterBankLoss() if path is None else Vgg19(path).to(device)
