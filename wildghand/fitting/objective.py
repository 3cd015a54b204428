"""The loss of a fit: the weighted reconstruction and the regularisers."""

from __future__ import annotations

from collections.abc import Mapping

import torch
from torch import Tensor

from wildghand.dpd.temporal_loss import TemporalTarget
from wildghand.fitting.networks import choose_perceptual
from wildghand.fitting.weighting import FrameTarget
from wildghand.gaussians.attributes import RawAttributes
from wildghand.gaussians.regularizers import attribute_roughness, off_surface, surface_laplacian
from wildghand.gaussians.rig import HandRig
from wildghand.gaussians.training import upload
from wildghand.model import terms
from wildghand.model.model import WildGHandModel
from wildghand.model.rendered import RenderedFrames
from wildghand.model.settings import WildGHandSettings
from wildghand.network import HandFeatures

#: Where batches are unless a fit says otherwise.
CPU = torch.device("cpu")


class Objective:
    """The loss of a batch, in two parts; terms of weight 0 cost nothing.

    Args:
        settings: weights of the terms.
        rigs: by side.
        temporal: what holds the temporal weights; None: nothing.
        device: where the batches are.

    Raises:
        UsageError: a perceptual network was chosen for a term of weight 0.
        HwpError: its weights cannot be used.
    """

    def __init__(
        self,
        settings: WildGHandSettings,
        rigs: Mapping[str, HandRig],
        temporal: TemporalTarget | None = None,
        device: torch.device = CPU,
    ) -> None:
        self.settings = settings
        self.temporal = temporal
        self.weights = settings.terms
        smooth = (
            self.weights.laplacian_offsets,
            self.weights.laplacian_scales,
            self.weights.laplacian_colors,
        )
        self._laplacians = (
            {side: surface_laplacian(rig) for side, rig in rigs.items()} if any(smooth) else {}
        )
        self._spacing = {side: rig.spacing for side, rig in rigs.items()}
        self._perceptual = choose_perceptual(settings, device)

    def __call__(
        self,
        model: WildGHandModel,
        drawing: RenderedFrames,
        target: FrameTarget,
        rows: Tensor,
        clean: Tensor,
    ) -> Tensor:
        """The terms that the frames enter, a scalar; `of_features` has the others.

        Args:
            model: what is fitted.
            drawing: of B frames.
            target: what they are compared with.
            rows: (B,) which of the training frames they are, on the CPU.
            clean: (B,) probability that a frame is clean, on the CPU.
        """
        weights, settings = self.weights, self.settings
        image = drawing.image
        exact = model.clip_poses is None
        dssim = weights.dssim_share(exact_poses=exact)
        total = weights.reconstruction * terms.reconstruction(
            image, target.image, target.weights, dssim
        )
        if self._perceptual is not None:
            found = self._perceptual(image, target.image, target.weights)
            total = total + weights.perceptual * found
        if weights.silhouette:
            total = total + weights.silhouette * terms.silhouette(drawing.coverage, target.hand)
        if weights.weight_reward and target.sizes is not None:
            total = total + weights.weight_reward * terms.weight_reward(target.sizes)
        for side, hand in drawing.hands.items():
            if weights.bias and hand.bias_size is not None:
                total = total + weights.bias * hand.bias_size
            if weights.shadow:
                total = total + weights.shadow * terms.distance_to_one(hand.prediction.shadow)
            if weights.opacity:
                total = total + weights.opacity * terms.distance_to_one(hand.opacities)
            if weights.surface:
                off = off_surface(
                    hand.prediction.raw,
                    model.network.activation,
                    self._spacing[side],
                    flatness=weights.flatness(exact_poses=exact),
                )
                total = total + weights.surface * off
            rough = self._roughness(side, hand.prediction.raw)
            total = total if rough is None else total + rough
        if self.temporal is not None and settings.dpd.omega_weight:
            held = self.temporal.temporal_loss(model.biases, int(rows[0]))
            total = total + settings.dpd.omega_weight * held
        if settings.dpd.gains:
            device, dpd = model.log_gains.device, settings.dpd
            gains = model.log_gains[upload(rows, device)]
            total = total + dpd.gain_weight * terms.gain_of_clean(gains, upload(clean, device))
            total = total + dpd.tint_weight * terms.tint_of_gains(gains)
        return total

    def of_features(self, features: Mapping[str, HandFeatures]) -> Tensor | None:
        """The terms that no frame enters, a scalar; None where there are none.

        Args:
            features: of the network, by side.
        """
        weights, found = self.weights, []
        if weights.laplacian_offsets and self.settings.heads.template:
            for side, hand in features.items():
                rough = self._laplacians[side].offsets(hand.template_offsets)
                found.append(weights.laplacian_offsets * rough)
        if weights.cross_hand and len(features) == 2:
            left, right = (features[side].texture for side in ("left", "right"))
            found.append(weights.cross_hand * terms.cross_hand(left, right))
        return torch.stack(found).sum() if found else None

    def _roughness(self, side: str, raw: RawAttributes) -> Tensor | None:
        """Weighted roughness of log scales and colours: one product with the Laplacian."""
        weights = self.weights.laplacian_scales, self.weights.laplacian_colors
        if not any(weights):
            return None
        return attribute_roughness(self._laplacians[side], raw, *weights)
