"""How strongly evidence acts, chosen by validation frames, which the fit has not seen.

Where a person's hand is far from the hand model, offsets from the skin are the person's and not
errors of depth, and evidence takes away what is right. Nothing in the training frames says so: they
are drawn without it.
"""

from __future__ import annotations

import functools
import time
from collections.abc import Mapping
from dataclasses import dataclass

import torch
from torch import Tensor

from hwp_bench.methods.contract import TrainingCapture
from wildghand.evidence import Evidence, EvidenceSettings, strengths, weigh_evidence
from wildghand.fitting.cast_shadows import Dark, shadows_in
from wildghand.gaussians.training import TrainingClip, TrainingFrames
from wildghand.model.model import WildGHandModel
from wildghand.model.settings import WildGHandSettings
from wildghand.network import HandFeatures


@dataclass(frozen=True, eq=False)
class EvidenceChoice:
    """The choice of the strength of evidence at the end of a fit."""

    #: What is drawn; its evidence is put back.
    model: WildGHandModel
    #: What may be seen of the capture.
    training: TrainingCapture
    #: Of the fit.
    settings: WildGHandSettings
    #: (N,) by side, how many training frames show each Gaussian.
    shown: Mapping[str, Tensor]
    #: Training frames that are fitted.
    frame_count: int
    #: Validation frames; None where they are too few.
    judges: TrainingFrames | None

    @property
    def frames(self) -> TrainingFrames | None:
        """The validation frames that judge; None also where nothing is chosen."""
        evidence = self.settings.evidence
        return self.judges if evidence.enabled and evidence.validated else None

    def best(self) -> Evidence | None:
        """The evidence that draws validation frames best; None where that is the model's own."""
        if self.frames is None:
            return None
        candidates = [self._evidence(index) for index in range(len(self._strengths))]
        features = self._features()
        errors = [self.error(evidence, features) for evidence in candidates]
        chosen = min(range(len(errors)), key=errors.__getitem__)  # the first of equal ones
        return candidates[chosen] if chosen else None

    def seconds(self) -> float:
        """Return about how long `best` takes; nothing of the model changes."""
        if self.frames is None:
            return 0.0
        own = self._evidence(0)
        self.error(own, self._features(), 1)  # The first time takes longer than others.
        entered = time.perf_counter()
        features = self._features()
        begun = time.perf_counter()
        self.error(own, features, 1)
        drawings = len(self._strengths) * len(self.frames)
        # With a light, which there is at the end alone, the network is asked twice.
        each = (time.perf_counter() - begun) * (2.0 if self.settings.light.enabled else 1.0)
        return begun - entered + each * drawings

    @torch.no_grad()
    def error(
        self,
        evidence: Evidence,
        features: Mapping[str, HandFeatures] | None = None,
        count: int | None = None,
    ) -> float:
        """Mean squared error of sRGB over the hand in validation frames, drawn with the evidence.

        Args:
            evidence: instead of the model's own.
            features: of the network by side, where they are at hand already.
            count: the first frames alone; None: all.
        """
        assert self.frames is not None
        before = self.model.evidence
        self.model.evidence = evidence
        try:
            squares, pixels = 0.0, 0.0
            for row in range(len(self.frames) if count is None else count):
                image, hand = self._truth(row)
                off = (self._drawn(row, features).clamp(0.0, 1.0) - image).square().mean(dim=-1)
                squares += float((off * hand).sum())
                pixels += float(hand.sum())
        finally:
            self.model.evidence = before
        return squares / pixels

    @functools.cached_property
    def _strengths(self) -> list[EvidenceSettings]:
        return strengths(self.settings.evidence)

    def _evidence(self, index: int) -> Evidence:
        return weigh_evidence(self.shown, self.frame_count, self._strengths[index])

    @functools.cached_property
    def _clip(self) -> TrainingClip:
        assert self.frames is not None
        device = self.model.log_gains.device
        return TrainingClip(self.training, self.frames.indices, self.model.rigs, device, 0)

    @functools.cached_property
    def _dark(self) -> Dark:
        """The shadows in the frames, cast at once, so that `seconds` has cast them."""
        assert self.frames is not None
        dark = shadows_in(self.model, self._clip)
        dark(torch.arange(len(self.frames)))
        return dark

    def _truth(self, row: int) -> tuple[Tensor, Tensor]:
        """(H, W, 3) image and (H, W) coverage of the hand in a validation frame."""
        assert self.frames is not None
        device = self.model.log_gains.device
        image = self.frames.images[row].to(device).float() / 255.0
        return image, self.frames.masks[row].to(device).float() / 255.0

    @torch.no_grad()
    def _features(self) -> dict[str, HandFeatures]:
        return {side: self.model.network.features(side) for side in self.model.rigs}

    def _drawn(self, row: int, features: Mapping[str, HandFeatures] | None) -> Tensor:
        """(H, W, 3) sRGB over black."""
        clip = self._clip
        hands = {
            side: (pose[row : row + 1], betas, transl[row : row + 1])
            for side, (pose, betas, transl) in clip.parameters.items()
        }
        here = slice(row, row + 1)
        size = self.training.width, self.training.height
        refine = self.settings.heads.refinement
        image, _ = self.model.draw(
            hands,
            clip.viewmats[here],
            clip.Ks[here],
            *size,
            refine=refine,
            features=features,
            dark=self._dark(torch.tensor([row])),
        )
        return image[0]
