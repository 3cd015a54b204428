"""The colours that one of two hands takes from the other, at the end of a fit.

Both hands of a person look alike. Where clean frames have shown a place of one hand, and that of
the other hand seldom or not at all, the other takes its colour. The network alone does not do this:
each hand has a map of its own.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from wildghand.evidence import ColorChanges, EvidenceSettings, kept_share, shown_frames
from wildghand.fitting.known_colors import changes_to, known_logits, log_linear
from wildghand.fitting.weighting import Weighting
from wildghand.gaussians.training import TrainingClip
from wildghand.model.model import WildGHandModel

# Weight of a frame from which its colours begin to count; what perturbs a frame changes them.
_UNSURE = 0.35
# A colour that is somebody's is better than none: it takes so much less to be lent.
_LENT = 0.25
_OTHER = {"left": "right", "right": "left"}


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
            return {side: kept_share(n, half).cpu().double().numpy() for side, n in shown.items()}

        return cls(model, clip, own=shares(half), lent=shares(_LENT * half))

    @torch.no_grad()
    def learn(self) -> ColorChanges | None:
        """The colours that the hands take; None where they take none.

        They are compared at normals that the clip's light knows; without a light nothing is taken.
        """
        light = self.model.light
        if not self.own or light is None:
            return None
        logits = {
            side: known_logits(self.model, self.clip, side, light) for side in self.model.rigs
        }
        levels = {side: log_linear(values) for side, values in logits.items()}
        mixed = {}
        for side, level in levels.items():
            difference = levels[_OTHER[side]] - level
            mixed[side] = level + self.taken(side)[:, None] * difference
        return changes_to(mixed, logits, self.model.log_gains.device)

    def taken(self, side: str) -> np.ndarray:
        """(N,) in [0, 1), how much of the other hand's colours a hand takes; of two hands."""
        return (1.0 - self.own[side]) * self.lent[_OTHER[side]]


def clearly_visible(weighting: Weighting) -> Callable[[Tensor], Tensor]:
    """How much pixels say of a hand's colour: as `visible`, but of frames that are sure alone."""
    weights = weighting.frame_weights
    sure = ((weights - _UNSURE) / (1.0 - _UNSURE)).clamp(0.0, 1.0) / weights.clamp(min=1e-3)

    def visible(rows: Tensor) -> Tensor:
        says = weighting.visible(rows)
        return says * sure[rows].to(says)[:, None, None]

    return visible
