"""Validation frames as an avatar draws them, in several ways that share what takes longest."""

from __future__ import annotations

import functools
import time
from collections.abc import Mapping
from dataclasses import dataclass

import torch
from torch import Tensor

from hwp_bench.methods.contract import TrainingCapture
from hwp_bench.metrics.pixels import scored_pixels
from hwp_bench.metrics.protocol import HWP_V1
from wildghand.evidence import ColorChanges, Evidence
from wildghand.fitting.cast_shadows import Dark, shadows_in
from wildghand.gaussians.training import TrainingClip, TrainingFrames
from wildghand.model.model import HandPrediction, WildGHandModel
from wildghand.model.settings import WildGHandSettings
from wildghand.network import HandFeatures

#: What network and light say of the hands in a frame, by side.
Predicted = Mapping[str, HandPrediction]


@dataclass(frozen=True)
class DrawingSeconds:
    """How long it takes to draw validation frames."""

    #: The network's features, which all frames share.
    features: float
    #: What network and light say of one frame.
    predict: float
    #: Drawing one frame and comparing it.
    draw: float


@dataclass(frozen=True, eq=False)
class JudgedDrawings:
    """Validation frames, which no step has seen, and how the model draws them."""

    #: What is drawn; its evidence and changes of colours are put back.
    model: WildGHandModel
    #: What may be seen of the capture.
    training: TrainingCapture
    #: Apply the network's refinement of the parameters (head iv).
    refine: bool
    #: Validation frames.
    frames: TrainingFrames

    @classmethod
    def of(
        cls,
        model: WildGHandModel,
        training: TrainingCapture,
        settings: WildGHandSettings,
        frames: TrainingFrames | None,
    ) -> JudgedDrawings | None:
        """As the settings of a fit say; None where there are no frames."""
        if frames is None:
            return None
        return cls(model, training, settings.heads.refinement, frames)

    @torch.no_grad()
    def features(self) -> dict[str, HandFeatures]:
        """Of the network, by side; all frames share them."""
        return {side: self.model.network.features(side) for side in self.model.rigs}

    @torch.no_grad()
    def predict(self, row: int, features: Mapping[str, HandFeatures]) -> Predicted:
        """What network and light say of the hands in a frame.

        Args:
            row: of the frame.
            features: of the network.
        """
        viewmats = self._clip.viewmats[row : row + 1]
        return {
            side: self.model.predict_hand(
                side,
                (pose[row : row + 1], betas, transl[row : row + 1]),
                viewmats,
                features[side],
            )
            for side, (pose, betas, transl) in self._clip.parameters.items()
        }

    def predict_all(self) -> dict[int, Predicted]:
        """What network and light say of the hands in all frames, by row."""
        features = self.features()
        return {row: self.predict(row, features) for row in range(len(self.frames))}

    @torch.no_grad()
    def error(
        self,
        predicted: Mapping[int, Predicted],
        evidence: Evidence | None,
        changes: ColorChanges | None,
    ) -> float:
        """Mean squared error of sRGB over the pixels of the hand that scoring looks at.

        Args:
            predicted: the frames, by row.
            evidence: instead of the model's own.
            changes: of colours, instead of the model's own.
        """
        model = self.model
        before = model.evidence, model.color_changes
        model.evidence, model.color_changes = evidence, changes
        try:
            squares, pixels = 0.0, 0.0
            for row, hands in predicted.items():
                image, hand = self._truth(row)
                off = (self._drawn(row, hands).clamp(0.0, 1.0) - image).square().mean(dim=-1)
                squares += float(off[hand].sum())
                pixels += float(hand.sum())
        finally:
            model.evidence, model.color_changes = before
        return squares / max(pixels, 1.0)

    @functools.cached_property
    def seconds(self) -> DrawingSeconds:
        """About how long things take, measured once; nothing of the model changes."""
        evidence, changes = self.model.evidence, self.model.color_changes
        # The first time takes longer than others.
        self.error({0: self.predict(0, self.features())}, evidence, changes)
        begun = time.perf_counter()
        features = self.features()
        shared = time.perf_counter()
        predicted = {0: self.predict(0, features)}
        asked = time.perf_counter()
        self.error(predicted, evidence, changes)
        return DrawingSeconds(shared - begun, asked - shared, time.perf_counter() - asked)

    @functools.cached_property
    def _clip(self) -> TrainingClip:
        device = self.model.log_gains.device
        return TrainingClip(self.training, self.frames.indices, self.model.rigs, device, 0)

    @functools.cached_property
    def _dark(self) -> Dark:
        """The shadows in the frames, cast at once: whoever draws one first has cast them all."""
        dark = shadows_in(self.model, self._clip)
        dark(torch.arange(len(self.frames)))
        return dark

    def _truth(self, row: int) -> tuple[Tensor, Tensor]:
        """(H, W, 3) image, and (H, W) bool, the pixels that are judged.

        Masks are estimates: the pixels at their border mix hand and background.
        """
        device = self.model.log_gains.device
        image = self.frames.images[row].to(device).float() / 255.0
        hand = scored_pixels(self.frames.masks[row].numpy(), erosion=HWP_V1.mask_erosion)
        return image, torch.from_numpy(hand).to(device)

    def _drawn(self, row: int, predicted: Predicted) -> Tensor:
        """(H, W, 3) sRGB over black."""
        dark, here = self._dark(torch.tensor([row])), slice(row, row + 1)
        found = {
            side: self.model.dressed(side, hand, refine=self.refine, dark=dark.get(side))
            for side, hand in predicted.items()
        }
        size = self.training.width, self.training.height
        image, _ = self.model.rasterize(
            found, self._clip.viewmats[here], self._clip.Ks[here], *size
        )
        return image[0]
