"""The mean of what is fitted over the last steps, which a fit ends with.

A fit of seconds ends while its rates are still high: what it learnt last are the last few frames.
The mean over the last tenth of its steps forgets which those were, and costs no step.
"""

from __future__ import annotations

import contextlib
from collections.abc import Iterable, Iterator, Mapping
from typing import Any

import numpy as np
import torch
from torch import Tensor

from hwp_bench.methods.contract import Avatar, Camera, HandPose
from wildghand.gaussians.adam import ClippedAdam


class StepAverage:
    """A running mean of tensors, in which a step counts the more, the later it is.

    After T steps, step t has about the weight (t / T) ** (1 / share - 1): nearly everything comes
    from the last `share` of them, whenever the fit ends.

    Source: Shamir and Zhang, "Stochastic gradient descent for non-smooth optimization",
    polynomial-decay averaging, with eta = 1 / share - 1.

    Args:
        tensors: what steps move; they are read at each call.
        share: of the steps, in [0, 1]; 0: the last step alone, 1: all of them alike.
    """

    def __init__(self, tensors: Iterable[Tensor], share: float) -> None:
        self._tensors = list(tensors)
        self._share = share
        self._steps = 0
        self._means: list[Tensor] = []

    @classmethod
    def of_optimizer(cls, optimizer: ClippedAdam, share: float) -> StepAverage:
        """The mean of everything that an optimizer moves."""
        return cls((p for group in optimizer.param_groups for p in group["params"]), share)

    @torch.no_grad()
    def take(self) -> None:
        """Take note of a step; with a share of 0 there is nothing to note."""
        if self._share == 0.0:
            return
        self._steps += 1
        if not self._means:
            self._means = [tensor.detach().clone() for tensor in self._tensors]
            return
        weight = 1.0 / (1.0 + self._share * (self._steps - 1))
        for mean, tensor in zip(self._means, self._tensors, strict=True):
            mean.lerp_(tensor, weight)

    def put(self) -> None:
        """Put the means in place of the tensors; without a step these stay."""
        if self._means:
            _copy(self._means, self._tensors)

    def values(self) -> list[Tensor]:
        """Copies of what `put` would put in place."""
        return [value.detach().clone() for value in self._means or self._tensors]

    def now(self) -> list[Tensor]:
        """Copies of the tensors as they are."""
        return [tensor.detach().clone() for tensor in self._tensors]

    def restore(self, values: Iterable[Tensor]) -> None:
        """Put what `values` or `now` returned in place of the tensors."""
        _copy(values, self._tensors)

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
        """The state for `load_state_dict`."""
        return {"steps": self._steps, "means": list(self._means)}

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Go on from a saved state."""
        self._steps = int(state["steps"])
        self._means = [mean.clone() for mean in state["means"]]


@torch.no_grad()
def _copy(values: Iterable[Tensor], tensors: Iterable[Tensor]) -> None:
    for value, tensor in zip(values, tensors, strict=True):
        # Past autograd's count of changes: a graph that several steps share stays open meanwhile,
        # and finds the values that it was made of when it is used.
        tensor.data.copy_(value)


class AveragedAvatar:
    """An avatar in the middle of a fit, drawn as it would be if the fit ended here.

    Args:
        avatar: of the tensors that steps move.
        average: of these.
    """

    def __init__(self, avatar: Avatar, average: StepAverage) -> None:
        self._avatar = avatar
        self._average = average

    @property
    def device(self) -> str:
        """Where it is drawn."""
        return str(getattr(self._avatar, "device", "cpu"))

    def render(self, hands: Mapping[str, HandPose], camera: Camera) -> np.ndarray:
        """See `hwp_bench.methods.contract.Avatar`."""
        with self._average.in_place():
            return self._avatar.render(hands, camera)
