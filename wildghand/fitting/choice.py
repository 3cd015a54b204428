"""Choices by validation frames, which no step sees, and the states of a fit that they choose from.

A fit of seconds ends while its rates are still high: what it learnt last are the last few frames.
The mean over the last tenth of its steps forgets which those were, and costs no step (`Averaging`).

A fit that goes on learns what is wrong in single frames: a pose that a tracker gave, a finger that
lies 3 px off its place. It draws its training frames the better for it, and others worse. How soon
that begins depends on how wrong the frames are, which nothing in them tells (`StateChoice`).
"""

from __future__ import annotations

import contextlib
import functools
import time
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass
from typing import Any, NamedTuple, TypeVar

import numpy as np
import torch
from torch import Tensor

from hwp_bench.methods.contract import Avatar, Camera, HandPose, TrainingCapture
from hwp_bench.metrics.pixels import scored_pixels
from hwp_bench.metrics.protocol import HWP_V1
from wildghand.fitting.fit import Component, Fit
from wildghand.gaussians.training import TrainingClip, TrainingFrames
from wildghand.light import ShadowTable
from wildghand.model.model import HandPrediction, WildGHandModel
from wildghand.network import HandFeatures
from wildghand.visibility import ColorChanges, Visibility

# How often a fit has seen each frame when the first of its states is kept.
_FIRST = 2.5
#: What network and light say of the hands in a frame, by side.
Predicted = Mapping[str, HandPrediction]
Candidate = TypeVar("Candidate")


def choose(
    candidates: Iterable[tuple[Candidate, float]],
    error: Callable[[Candidate], float],
    start: tuple[Candidate, float] | None = None,
    *,
    patient: bool = True,
) -> tuple[Candidate, float]:
    """The candidate of lowest error, and its error.

    Args:
        candidates: each with the share by which it must lower the error of the best one before it.
        start: the best one before them, and its error; None: the first of them, at least one.
        patient: look at all of them; else only until one does not improve.
    """
    listed = iter(candidates)
    if start is None:
        best, _ = next(listed)
        start = best, error(best)
    best, least = start
    for candidate, gain in listed:
        found = error(candidate)
        if found < (1.0 - gain) * least:
            best, least = candidate, found
        elif not patient:
            break
    return best, least


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
        """What network and light say of the hands in a frame."""
        here = slice(row, row + 1)
        return {
            side: self.model.predict_hand(
                side, (pose[here], betas, transl[here]), self._clip.viewmats[here], features[side]
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
        visibility: Visibility | None,
        changes: ColorChanges | None,
    ) -> float:
        """Mean squared error of sRGB over the pixels of the hand that scoring looks at."""
        model = self.model
        before = model.visibility, model.color_changes
        model.visibility, model.color_changes = visibility, changes
        try:
            squares, pixels = 0.0, 0.0
            for row, hands in predicted.items():
                image, hand = self._truth(row)
                off = (self._drawn(row, hands).clamp(0.0, 1.0) - image).square().mean(dim=-1)
                squares += float(off[hand].sum())
                pixels += float(hand.sum())
        finally:
            model.visibility, model.color_changes = before
        return squares / max(pixels, 1.0)

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
        """The shadows in the frames, cast at once: whoever draws one first has cast them all."""
        if self.model.shadows is None:
            return None
        dark = ShadowTable(self.model.shadows, self._clip)
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


class Averaging(Component):
    """A fit ends with a running mean of its steps; a step counts the more, the later it is.

    After T steps, step t has about the weight (t / T) ** (1 / share - 1): nearly everything comes
    from the last `share` of them, whenever the fit ends. With a share of 0 it is the last step
    alone, with 1 all of them alike.

    Source: Shamir and Zhang, "Stochastic gradient descent for non-smooth optimization",
    polynomial-decay averaging, with eta = 1 / share - 1.

    Args:
        tensors: what steps move; they are read at each call. `begin` takes those of the fit.
        share: of the steps, in [0, 1].
    """

    def __init__(self, tensors: Iterable[Tensor] = (), share: float = 0.0) -> None:
        self._tensors = list(tensors)
        self._share = share
        self._steps = 0
        self._means: list[Tensor] = []

    def begin(self, fit: Fit) -> None:
        """Take what the fit's steps move."""
        self._tensors, self._share = fit.descent.tensors(), fit.settings.schedule.average_share

    def after_step(self, fit: Fit) -> None:
        """Take note of a step."""
        self.take()

    @torch.no_grad()
    def take(self) -> None:
        """Take note of a step; with a share of 0 there is nothing to note."""
        if self._share == 0.0:
            return
        self._steps += 1
        if not self._means:
            self._means = self.now()
            return
        weight = 1.0 / (1.0 + self._share * (self._steps - 1))
        for mean, tensor in zip(self._means, self._tensors, strict=True):
            mean.lerp_(tensor, weight)

    def after(self, fit: Fit) -> None:
        """Put the mean in place."""
        self.put()

    def put(self) -> None:
        """Put the means in place of the tensors; without a step these stay."""
        if self._means:
            self.restore(self._means)

    def values(self) -> list[Tensor]:
        """Copies of what `put` would put in place."""
        return [value.detach().clone() for value in self._means or self._tensors]

    def now(self) -> list[Tensor]:
        """Copies of the tensors as they are."""
        return [tensor.detach().clone() for tensor in self._tensors]

    @torch.no_grad()
    def restore(self, values: Iterable[Tensor]) -> None:
        """Put what `values` or `now` returned in place of the tensors."""
        for value, tensor in zip(values, self._tensors, strict=True):
            # Past autograd's count of changes: a graph that several steps share stays open
            # meanwhile, and finds the values that it was made of when it is used.
            tensor.data.copy_(value)

    def forget(self) -> None:
        """Begin again, as before the first step."""
        self._steps, self._means = 0, []

    @contextlib.contextmanager
    def in_place(self) -> Iterator[None]:
        """Within this, the tensors are their means; a step may not be taken meanwhile."""
        kept = self.now()
        self.put()
        try:
            yield
        finally:
            self.restore(kept)

    def checkpoint(self, avatar: Avatar) -> Avatar:
        """See `Component`."""
        return AveragedAvatar(avatar, self)

    def state_dict(self) -> dict[str, Any]:
        """See `Component`."""
        return {"steps": self._steps, "means": list(self._means)}

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """See `Component`."""
        self._steps = int(state["steps"])
        self._means = [mean.clone() for mean in state["means"]]


@dataclass(frozen=True, eq=False)
class AveragedAvatar:
    """An avatar in the middle of a fit, drawn as it would be if the fit ended here."""

    avatar: Avatar
    #: Of the tensors that the avatar is drawn from.
    average: Averaging

    @property
    def device(self) -> str:
        """Where it is drawn."""
        return str(getattr(self.avatar, "device", "cpu"))

    def render(self, hands: Mapping[str, HandPose], camera: Camera) -> np.ndarray:
        """See `hwp_bench.methods.contract.Avatar`."""
        with self.average.in_place():
            return self.avatar.render(hands, camera)


class StateChoice(Component):
    """After the last step a fit goes back to an earlier state that draws validation frames better.

    States are means of its steps, kept after some of them and each time after twice as many.
    Visibility is chosen for the state that is kept, and has no say before.

    Args:
        average: the mean of the steps so far. `begin` takes that of the fit.
        first: steps until the first state is kept, at least 1; 0: none ever is.

    Attributes:
        judges: validation frames; None: the fit ends with its last state.
        chosen: steps behind the state that was gone back to; None: it is the last one.
    """

    judges: JudgedDrawings | None
    chosen: int | None = None

    def __init__(self, average: Averaging | None = None, first: int = 0) -> None:
        self._average = average or Averaging()
        self._first = first
        self._steps = 0
        self._kept: dict[int, list[Tensor]] = {}

    def begin(self, fit: Fit) -> None:
        """Keep states by how often the fit has seen its frames; none where nothing judges."""
        averaging, frames = fit.part(Averaging), fit.part(ValidationFrames)
        assert averaging is not None
        self._average = averaging
        self.judges = None if frames is None else frames.drawings
        self._first = 0 if self.judges is None else max(1, round(_FIRST * fit.epoch))

    def after_step(self, fit: Fit) -> None:
        """Take note of a step."""
        self.take()

    def take(self) -> None:
        """Take note of a step, after the average has."""
        self._steps += 1
        if self._steps == self._first * 2 ** len(self._kept):
            self._kept[self._steps] = self._average.values()

    def forget(self) -> None:
        """See `Component`."""
        self._steps, self._kept = 0, {}

    @property
    def candidates(self) -> list[int]:
        """Steps behind the states that may be gone back to, the last one first.

        Those from more than half of the steps are too near to the end to differ from it.
        """
        return [step for step in sorted(self._kept, reverse=True) if 2 * step <= self._steps]

    def after(self, fit: Fit) -> None:
        """Bring the model to the state that draws the validation frames best."""
        if self.judges is None:
            return
        self.chosen = self.go_back(self.error)
        if self.chosen is not None:
            fit.tell(
                f"The state of step {self.chosen} draws the validation frames best; it is kept."
            )

    def go_back(self, error: Callable[[], float]) -> int | None:
        """Go back, from the state that is there, as long as that makes an error smaller."""
        candidates = self.candidates
        if not candidates:
            return None
        steps: list[int | None] = [None, *candidates]
        states = [self._average.now(), *(self._kept[step] for step in candidates)]

        def error_of(row: int) -> float:
            self._average.restore(states[row])
            return error()

        chosen, _ = choose([(row, 0.0) for row in range(len(steps))], error_of, patient=False)
        self._average.restore(states[chosen])
        return steps[chosen]

    def error(self) -> float:
        """Mean squared error of the validation frames as the model draws them now."""
        assert self.judges is not None
        changes = self.judges.model.color_changes
        return self.judges.error(self.judges.predict_all(), None, changes)

    def seconds_now(self, fit: Fit) -> float:
        """About how long the choice among the states so far takes."""
        count = len(self.candidates)
        if self.judges is None or not count:
            return 0.0
        took = self.judges.seconds
        each = took.features + (took.predict + took.draw) * len(self.judges.frames)
        return (1 + count) * each

    def record(self, fit: Fit, *, final: bool) -> dict[str, Any]:
        """Steps behind the state that is kept, if it is an earlier one than the last."""
        return {"chosen_steps": self.chosen}

    def state_dict(self) -> dict[str, Any]:
        """See `Component`."""
        return {"steps": self._steps, "kept": dict(self._kept)}

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """See `Component`."""
        self._steps = int(state["steps"])
        self._kept = {
            int(step): [value.clone() for value in values] for step, values in state["kept"].items()
        }
