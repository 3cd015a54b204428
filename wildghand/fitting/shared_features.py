"""Texture features that several steps of a fit share."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

import torch
from torch import Tensor

from wildghand.network import HandFeatures, PredictionNetwork

Features = Mapping[str, HandFeatures]


class SharedFeatures:
    """Features of the hands, evaluated once for a block of steps.

    Texture features do not depend on the frame. So the steps of a block draw different frames of
    one evaluation of them, as the frames of a batch would. Their gradients are added up, and at
    the end of the block the texture branch takes the mean, once. Everything else moves at every
    step, also the identity map through the direct path.

    Args:
        network: it predicts the features.
        every: steps of a block; 1: nothing is shared.
        terms: of the loss that no frame enters, see `Objective.of_features`.

    Attributes:
        value: of these terms at the start of the block, without gradient.
    """

    def __init__(
        self,
        network: PredictionNetwork,
        every: int,
        terms: Callable[[Features], Tensor | None],
    ) -> None:
        self.value = torch.zeros(())
        self._network = network
        self._every = every
        self._terms = terms
        self._steps = 0
        #: With their graph, and as the steps see them.
        self._made: dict[str, HandFeatures] = {}
        self._given: dict[str, HandFeatures] = {}
        self._loss: Tensor | None = None
        self._maps: dict[str, Tensor] = {}
        self._sum: Tensor | float = 0.0

    def features(self) -> Features:
        """The features of this step, by side."""
        if not self._given:
            self._begin()
        return self._given

    def backward(self, loss: Tensor, mean: Tensor) -> Tensor:
        """The backward pass of a step; at the end of a block also that of the features.

        Args:
            loss: of the frames, a scalar.
            mean: of the loss over all processes, without gradient.

        Returns:
            The sum of `mean` over the block so far: where it is not finite, nor are gradients.
        """
        self._steps += 1
        self._sum = self._sum + mean
        total = self._sum
        if self._every == 1:
            (loss if self._loss is None else loss + self._loss).backward()
            self._close()
            return total
        loss.backward()
        if self._steps == self._every:
            self._share_out()
            self._close()
        return total

    def state_dict(self) -> dict[str, Any]:
        """The state for `load_state_dict`, also within a block."""
        if self._steps == 0:
            return {"steps": 0}
        return {
            "steps": self._steps,
            "maps": {side: values.clone() for side, values in self._maps.items()},
            "gradients": {
                side: [tensor.grad for tensor in given.tensors()]
                for side, given in self._given.items()
            },
            "sum": torch.as_tensor(self._sum),
        }

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Go on from a saved state; the network's own must be loaded before."""
        self._close()
        if not state["steps"]:
            return
        # Only the identity map moves within a block: features are made again from the one that
        # the block began with.
        maps = self._network.identity.maps
        with torch.no_grad():
            now = {side: values.clone() for side, values in maps.items()}
            for side, values in state["maps"].items():
                maps[side].copy_(values)
        self._begin()
        with torch.no_grad():
            for side, values in now.items():
                maps[side].copy_(values)
        for side, gradients in state["gradients"].items():
            for tensor, gradient in zip(self._given[side].tensors(), gradients, strict=True):
                tensor.grad = gradient
        self._steps, self._sum = int(state["steps"]), state["sum"]

    def _begin(self) -> None:
        network = self._network
        self._made = {side: network.features(side) for side in network.charts}
        self._loss = self._terms(self._made)
        self.value = torch.zeros(()) if self._loss is None else self._loss.detach()
        self._given = self._made
        if self._every > 1:
            self._maps = {side: m.detach().clone() for side, m in network.identity.maps.items()}
            self._given = {
                side: made.map(lambda tensor: tensor.detach().requires_grad_())
                for side, made in self._made.items()
            }

    def _share_out(self) -> None:
        """Give the texture branch the mean of the gradients of the block."""
        roots: list[Tensor] = [] if self._loss is None else [self._loss]
        gradients: list[Tensor | None] = [None] * len(roots)
        for side, features in self._made.items():
            pairs = zip(features.tensors(), self._given[side].tensors(), strict=True)
            for tensor, given in pairs:
                if given.grad is not None and tensor.requires_grad:
                    roots.append(tensor)
                    gradients.append(given.grad / self._every)
        torch.autograd.backward(roots, gradients)

    def _close(self) -> None:
        self._steps, self._sum, self._loss = 0, 0.0, None
        self._made, self._given, self._maps = {}, {}, {}
