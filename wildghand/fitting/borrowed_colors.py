"""The colours that one of two hands takes from the other, at the end of a fit.

Both hands of a person look alike. Where clean frames have shown a place of one hand, and that of
the other hand seldom or not at all, the other takes its colour. The network alone does not do this:
each hand has a map of its own.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from hwp_bench.base.colors import linear_to_srgb, srgb_to_linear
from wildghand.evidence import EvidenceSettings, OtherHand, shown_frames
from wildghand.fitting.weighting import Weighting
from wildghand.gaussians.training import TrainingClip
from wildghand.light import KnownLight
from wildghand.light.sphere import ring_around
from wildghand.model.model import WildGHandModel

# Weight of a frame from which its colours begin to count; what perturbs a frame changes them.
_UNSURE = 0.35
# A colour that is somebody's is better than none: it takes so much less to be lent.
_LENT = 0.25
# Poses and normals at which hands are compared: normals of the cap that the light knows, at this
# share of its angle around its axis.
_POSES, _RING, _INSIDE = 5, 4, 0.6
# sRGB nearer to 0 or 1, and linear light below this, say nothing.
_EDGE, _DARKEST = 0.005, 1e-3


@dataclass(frozen=True, eq=False)
class BorrowedColors:
    """How far two hands know their colours, before the first step; `learn` ends the fit."""

    #: What is read; it goes on changing until the colours are learnt.
    model: WildGHandModel
    #: Hands of the R frames.
    clip: TrainingClip
    #: (N,) by side in [0, 1), how far each Gaussian's colour is the hand's own; empty: nothing is
    #: taken.
    own: Mapping[str, np.ndarray]
    #: (N,) by side in [0, 1), how far it is good enough for the other hand.
    lent: Mapping[str, np.ndarray]

    @classmethod
    def of(
        cls,
        model: WildGHandModel,
        clip: TrainingClip,
        weighting: Weighting,
        settings: EvidenceSettings,
    ) -> BorrowedColors:
        """Count what clean frames show of each hand.

        Args:
            model: of one hand, which takes nothing, or two.
            clip: hands and cameras of the frames.
            weighting: how much each pixel says of the hand.
            settings: how.
        """
        if len(model.rigs) < 2 or not settings.enabled or settings.color_share <= 0.0:
            return cls(model, clip, {}, {})
        count = len(weighting.frame_weights)
        shown = shown_frames(model.rigs, clip, clearly_visible(weighting), count)
        half = settings.color_share * count

        def shares(half: float) -> dict[str, np.ndarray]:
            return {side: (n / (n + half)).cpu().double().numpy() for side, n in shown.items()}

        return cls(model, clip, own=shares(half), lent=shares(_LENT * half))

    @torch.no_grad()
    def learn(self) -> OtherHand | None:
        """The colours that the hands take; None where they take none.

        They are compared at normals that the clip's light knows; without a light nothing is taken.
        """
        light = self.model.light
        if not self.own or light is None:
            return None
        logits = {side: self._logits(side, light) for side in self.model.rigs}
        levels = {side: _log_linear(values) for side, values in logits.items()}
        changes = {}
        for side, other in (("left", "right"), ("right", "left")):
            share = ((1.0 - self.own[side]) * self.lent[other])[:, None]
            mixed = levels[side] + share * (levels[other] - levels[side])
            srgb = linear_to_srgb(np.exp(mixed)).clip(_EDGE, 1.0 - _EDGE)
            change = np.log(srgb / (1.0 - srgb)) - logits[side]
            device = self.model.log_gains.device
            changes[side] = torch.as_tensor(change, dtype=torch.float32, device=device)
        return OtherHand({side: changes[side] for side in self.model.rigs})

    def _logits(self, side: str, light: KnownLight) -> np.ndarray:
        """(N, 3) mean colour over known normals and poses of the clip, in logits of sRGB."""
        model, poses = self.model, self.clip.parameters[side][0]
        normals = known_normals(light).to(poses)
        rows = torch.linspace(0, len(poses) - 1, len(normals)).long().to(poses.device)
        spread = normals[:, None].expand(-1, len(model.rigs[side]), 3).contiguous()
        made = model.network(side, spread, poses[rows], model.network.features(side))
        colors = (made.raw.logit_colors.sigmoid() * made.shadow).clamp(_EDGE, 1.0 - _EDGE)
        found: np.ndarray = torch.logit(colors).mean(dim=0).double().cpu().numpy()
        return found


def clearly_visible(weighting: Weighting) -> Callable[[Tensor], Tensor]:
    """How much pixels say of a hand's colour: as `visible`, but of frames that are sure alone."""
    weights = weighting.frame_weights
    sure = ((weights - _UNSURE) / (1.0 - _UNSURE)).clamp(0.0, 1.0) / weights.clamp(min=1e-3)

    def visible(rows: Tensor) -> Tensor:
        says = weighting.visible(rows)
        return says * sure[rows].to(says)[:, None, None]

    return visible


def known_normals(light: KnownLight) -> Tensor:
    """(5, 3) normals of the cap that a light knows: its axis, and four around it."""
    axis = light.axis.double().cpu().numpy()
    axis = axis / max(float(np.linalg.norm(axis)), 1e-6)
    angle = _INSIDE * math.acos(max(-1.0, min(1.0, float(light.cosine))))
    return torch.from_numpy(np.concatenate([axis[None], ring_around(axis, angle, _RING)])).float()


def _log_linear(logits: np.ndarray) -> np.ndarray:
    """Logarithm of linear light of colours in logits of sRGB."""
    linear = srgb_to_linear(1.0 / (1.0 + np.exp(-logits)))
    return np.log(np.clip(linear, _DARKEST, 1.0))
