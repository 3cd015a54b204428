"""Training frames as the model explains them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from wildghand.network import NetworkOutput


@dataclass(frozen=True, eq=False)
class HandState:
    """State of one hand in B training frames; the regularisers read it."""

    #: Output of the network.
    prediction: NetworkOutput
    #: Mean over Gaussians and frames of the sum of |bias| over the channels, a scalar; None while
    #: perturbations are not modelled.
    bias_size: Tensor | None
    #: (B,) temporal weight before dropout; zeros while perturbations are not modelled.
    omega: Tensor
    #: (B, N) opacities that were drawn.
    opacities: Tensor


@dataclass(frozen=True, eq=False)
class RenderedFrames:
    """B training frames as the model explains them."""

    #: (B, H, W, 3) sRGB over black, with the frames' gains.
    image: Tensor
    #: (B, H, W, 1) coverage.
    coverage: Tensor
    #: By side.
    hands: Mapping[str, HandState]

    @property
    def omega(self) -> Tensor:
        """(B,) the temporal weight of largest magnitude among the hands."""
        return largest([hand.omega for hand in self.hands.values()])


def largest(omegas: Sequence[Tensor]) -> Tensor:
    """The temporal weights of largest magnitude among the hands, (B,).

    Args:
        omegas: (B,) of each hand, at least one.
    """
    if len(omegas) == 1:
        return omegas[0]
    weights = torch.stack([*omegas])
    chosen = weights.abs().argmax(dim=0, keepdim=True)
    return weights.gather(0, chosen)[0]
