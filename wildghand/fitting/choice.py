"""Choices by validation frames, which no step sees, among the states of a fit; see
`wildghand.plain.choice`.
"""

from __future__ import annotations

import functools
import time
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, NamedTuple

import torch
from torch import Tensor

from hwp_bench.methods.contract import Avatar, TrainingCapture
from wildghand.fitting.fit import Component, Fit
from wildghand.gaussians.training import TrainingClip, TrainingFrames
from wildghand.light import ShadowTable
from wildghand.model.model import HandPrediction, WildGHandModel
from wildghand.network import HandFeatures
from wildghand.plain.choice import (
    AveragedAvatar,
    Averaging,
    KeptStates,
    steps_to_first,
    validation_error,
)
from wildghand.visibility import ColorChanges, Visibility

#: What network and light say of the hands in a frame, by side.
Predicted = Mapping[str, HandPrediction]


class ValidationFrames(Component):
    """The frames that choose.

    Attributes:
        drawings: of these frames; None where they are too few.
    """

    drawings: JudgedDrawings | None = None

    def before(self, fit: Fit) -> None:
        """Have them drawn by the model."""
        data = fit.data
        if data.judges is not None:
            refine = fit.settings.heads
            self.drawings = JudgedDrawings(fit.model, data.training, refine, data.judges)


class DrawingSeconds(NamedTuple):
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

    #: What is drawn; its visibility and changes of colours are put back.
    model: WildGHandModel
    #: What may be seen of the capture.
    training: TrainingCapture
    #: Apply the network's refinement of the parameters (head iv).
    refine: bool
    #: Validation frames.
    frames: TrainingFrames

    @torch.no_grad()
    def features(self) -> dict[str, HandFeatures]:
        """Of the network, by side; all frames share them."""
        return {side: self.model.network.features(side) for side in self.model.rigs}

    @torch.no_grad()
    def predict(self, row: int, features: Mapping[str, HandFeatures]) -> Predicted:
        """Predict the hands in a frame by network and light."""
        here = slice(row, row + 1)
        return {
            side: self.model.predict_hand(
                side, (pose[here], betas, transl[here]), self._clip.viewmats[here], features[side]
            )
            for side, (pose, betas, transl) in self._clip.parameters.items()
        }

    def predict_all(self) -> dict[int, Predicted]:
        """Predict the hands in all frames by network and light, by row."""
        features = self.features()
        return {row: self.predict(row, features) for row in range(len(self.frames))}

    @torch.no_grad()
    def error(
        self,
        predicted: Mapping[int, Predicted],
        visibility: Visibility | None,
        changes: ColorChanges | None,
    ) -> float:
        """See `validation_error`."""
        model = self.model
        before = model.visibility, model.color_changes
        model.visibility, model.color_changes = visibility, changes
        try:
            drawn = ((row, self._drawn(row, hands)) for row, hands in predicted.items())
            return validation_error(self.frames, drawn)
        finally:
            model.visibility, model.color_changes = before

    @functools.cached_property
    def seconds(self) -> DrawingSeconds:
        """About how long things take, measured once; nothing of the model changes."""
        visibility, changes = self.model.visibility, self.model.color_changes
        # The first time takes longer than others.
        self.error({0: self.predict(0, self.features())}, visibility, changes)
        begun = time.perf_counter()
        features = self.features()
        shared = time.perf_counter()
        predicted = {0: self.predict(0, features)}
        asked = time.perf_counter()
        self.error(predicted, visibility, changes)
        return DrawingSeconds(shared - begun, asked - shared, time.perf_counter() - asked)

    @functools.cached_property
    def _clip(self) -> TrainingClip:
        device = self.model.log_gains.device
        return TrainingClip(self.training, self.frames.indices, self.model.rigs, device, 0)

    @functools.cached_property
    def _dark(self) -> ShadowTable | None:
        """The shadows in the frames, all cast when the first one is drawn."""
        if self.model.shadows is None:
            return None
        dark = ShadowTable(self.model.shadows, self._clip)
        dark(torch.arange(len(self.frames)))
        return dark

    def _drawn(self, row: int, predicted: Predicted) -> Tensor:
        """(H, W, 3) sRGB over black."""
        dark = {} if self._dark is None else self._dark(torch.tensor([row]))
        viewmats, Ks = self._clip.viewmats[row : row + 1], self._clip.Ks[row : row + 1]
        found = {
            side: self.model.dressed(
                side, hand, refine=self.refine, dark=dark.get(side), viewmats=viewmats
            )
            for side, hand in predicted.items()
        }
        size = self.training.width, self.training.height
        image, _ = self.model.rasterize(found, viewmats, Ks, *size)
        return image[0]


class AveragedSteps(Averaging, Component):
    """A fit ends with a running mean of its steps; see `Averaging`."""

    def begin(self, fit: Fit) -> None:
        """Take what the fit's steps move."""
        self._tensors, self._share = fit.descent.tensors(), fit.settings.schedule.average_share

    def after_step(self, fit: Fit) -> None:
        """Take note of a step."""
        self.take()

    def after(self, fit: Fit) -> None:
        """Replace the last state by the mean."""
        self.put()

    def checkpoint(self, avatar: Avatar) -> Avatar:
        """See `Component`."""
        return AveragedAvatar(avatar, self)


class StateChoice(KeptStates, Component):
    """After the last step a fit goes back to a better earlier state; see `KeptStates`.

    Visibility is chosen for the state that is kept, and not used before.

    Attributes:
        judges: validation frames; None: the fit ends with its last state.
    """

    judges: JudgedDrawings | None

    def begin(self, fit: Fit) -> None:
        """Keep states by how often the fit has seen its frames; none where nothing judges."""
        average, frames = fit.part(AveragedSteps), fit.part(ValidationFrames)
        assert average is not None
        self._average = average
        self.judges = None if frames is None else frames.drawings
        self._first = 0 if self.judges is None else steps_to_first(fit.epoch)

    def after_step(self, fit: Fit) -> None:
        """Take note of a step."""
        self.take()

    def after(self, fit: Fit) -> None:
        """Bring the model to the state that draws the validation frames best."""
        self.go_back(self.error, fit.tell)

    def error(self) -> float:
        """Mean squared error of the validation frames as the model draws them now."""
        assert self.judges is not None
        changes = self.judges.model.color_changes
        return self.judges.error(self.judges.predict_all(), None, changes)

    def seconds_now(self, fit: Fit) -> float:
        """About how long the choice among the states so far takes."""
        if self.judges is None or not self.most_drawn:
            return 0.0
        took = self.judges.seconds
        each = took.features + (took.predict + took.draw) * len(self.judges.frames)
        return self.most_drawn * each

    def record(self, fit: Fit, *, final: bool) -> dict[str, Any]:
        """Steps behind the state that is kept, if it is an earlier one than the last."""
        return {"chosen_steps": self.chosen}
