"""The state that a fit ends with: a running mean of its steps, or an earlier such mean.

A fit of seconds ends while its learning rates are still high, so its last state depends on the last
few frames. A running mean, two thirds of it from the last tenth of the steps, does not, and costs
no step (`Averaging`).

A long fit learns the errors of single frames, such as a tracked pose whose finger is 3 px off. It
then draws training frames better and other frames worse. How soon that begins depends on the size
of the errors, which is unknown. So validation frames, which no step uses, choose the state
(`KeptStates`).
"""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass
from typing import Any, TypeVar

import numpy as np
import torch
from torch import Tensor

from hwp_bench.base.console import notice
from hwp_bench.methods.contract import Avatar, Camera, HandPose
from hwp_bench.metrics.pixels import scored_pixels
from hwp_bench.metrics.protocol import HWP_V1
from wildghand.gaussians.training import TrainingFrames

# How often a fit has seen each frame when the first of its states is kept.
_FIRST = 2.5
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


def validation_error(frames: TrainingFrames, drawn: Iterable[tuple[int, Tensor]]) -> float:
    """Mean squared error of sRGB over the pixels of the hand that scoring looks at.

    Masks are estimates: the pixels at their border mix hand and background.

    Args:
        frames: validation frames.
        drawn: rows of these frames, each with its drawing, (H, W, 3) sRGB over black.
    """
    squares, pixels = 0.0, 0.0
    for row, drawing in drawn:
        image = frames.images[row].to(drawing.device).float() / 255.0
        scored = scored_pixels(frames.masks[row].numpy(), erosion=HWP_V1.mask_erosion)
        hand = torch.from_numpy(scored).to(drawing.device)
        off = (drawing.clamp(0.0, 1.0) - image).square().mean(dim=-1)
        squares += float(off[hand].sum())
        pixels += float(hand.sum())
    return squares / max(pixels, 1.0)


class Averaging:
    """A fit ends with a running mean of its steps; a step counts the more, the later it is.

    After T steps, step t has about the weight (t / T) ** (1 / share - 1): the last `share` of them
    has 1 - (1 - share) ** (1 / share) of the mean, 65 % for 0.1, and the last fifth has 89 % then,
    whenever the fit ends. With a share of 0 it is the last step alone, with 1 all of them alike.

    Source: Shamir and Zhang, "Stochastic gradient descent for non-smooth optimization",
    polynomial-decay averaging, with eta = 1 / share - 1.

    Args:
        tensors: what steps move; they are read at each call.
        share: of the steps, in [0, 1].
    """

    def __init__(self, tensors: Iterable[Tensor] = (), share: float = 0.0) -> None:
        self._tensors = list(tensors)
        self._share = share
        self._steps = 0
        self._means: list[Tensor] = []

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

    def put(self) -> None:
        """Replace the tensors by their means; without a step they stay."""
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

    def state_dict(self) -> dict[str, Any]:
        """What steps change, for `load_state_dict`."""
        return {"steps": self._steps, "means": list(self._means)}

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Continue from a saved state."""
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


class KeptStates:
    """After the last step a fit goes back to an earlier state that draws validation frames better.

    States are means of its steps, kept after some of them and each time after twice as many.

    Args:
        average: the mean of the steps so far.
        first: steps until the first state is kept, at least 1; 0: none ever is.

    Attributes:
        chosen: steps behind the state that was gone back to; None: it is the last one.
    """

    chosen: int | None = None

    def __init__(self, average: Averaging | None = None, first: int = 0) -> None:
        self._average = average or Averaging()
        self._first = first
        self._steps = 0
        self._kept: dict[int, list[Tensor]] = {}

    def take(self) -> None:
        """Take note of a step, after the average has."""
        self._steps += 1
        if self._steps == self._first * 2 ** len(self._kept):
            self._kept[self._steps] = self._average.values()

    def forget(self) -> None:
        """Begin again, as before the first step."""
        self._steps, self._kept = 0, {}

    @property
    def candidates(self) -> list[int]:
        """Steps behind the states that may be gone back to, the last one first.

        Those from more than half of the steps are too near to the end to differ from it.
        """
        return [step for step in sorted(self._kept, reverse=True) if 2 * step <= self._steps]

    @property
    def most_drawn(self) -> int:
        """How many states `go_back` draws at most, the last one included."""
        count = len(self.candidates)
        return count + 1 if count else 0

    def go_back(self, error: Callable[[], float], tell: Callable[[str], None] = notice) -> None:
        """Go back, from the state that is there, as long as that makes an error smaller.

        Args:
            error: of the state that the tensors are in.
            tell: print a notice if an earlier state is taken.
        """
        if not self.most_drawn:
            return
        steps: list[int | None] = [None, *self.candidates]
        states = [self._average.now(), *(self._kept[step] for step in self.candidates)]

        def error_of(row: int) -> float:
            self._average.restore(states[row])
            return error()

        best, _ = choose([(row, 0.0) for row in range(len(steps))], error_of, patient=False)
        self._average.restore(states[best])
        self.chosen = steps[best]
        if self.chosen is not None:
            tell(f"The state of step {self.chosen} draws the validation frames best; it is kept.")

    def state_dict(self) -> dict[str, Any]:
        """What steps change, for `load_state_dict`."""
        return {"steps": self._steps, "kept": dict(self._kept)}

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Continue from a saved state."""
        self._steps = int(state["steps"])
        self._kept = {
            int(step): [value.clone() for value in values] for step, values in state["kept"].items()
        }


def steps_to_first(epoch: float) -> int:
    """Steps after which a fit keeps its first state.

    Args:
        epoch: steps that look at as many frames as there are.
    """
    return max(1, round(_FIRST * epoch))
