"""How much of a frame's gradient the canonical hand takes."""

from __future__ import annotations

import dataclasses
from typing import Any

import torch
from torch import Tensor

from wildghand.gaussians.attributes import RawAttributes
from wildghand.network import NetworkOutput
from wildghand.network.network import Refinement


class _Share(torch.autograd.Function):
    """The tensor itself; its gradient times a factor."""

    @staticmethod
    def forward(ctx: Any, values: Tensor, factor: Tensor) -> Tensor:
        ctx.save_for_backward(factor)
        return values.view_as(values)

    @staticmethod
    def backward(ctx: Any, *gradients: Tensor) -> tuple[Tensor, None]:
        (factor,) = ctx.saved_tensors
        return gradients[0] * factor, None


def scale_gradients(prediction: NetworkOutput, shares: Tensor) -> NetworkOutput:
    """The same output, which learns from each of B frames by its share.

    What belongs to a single frame (biases, gain, pose) still learns from all of its gradient: a
    perturbed frame is explained by what is particular to it and hardly changes the hand. Weighing
    the frame's loss instead would silence both.

    Args:
        prediction: of B frames.
        shares: (B,) in [0, 1], without gradient.
    """
    return dataclasses.replace(
        prediction,
        raw=RawAttributes(
            **{name: _by_frame(values, shares) for name, values in prediction.raw.items()}
        ),
        shadow=_by_frame(prediction.shadow, shares),
        template_offsets=_by_frame(prediction.template_offsets.expand(len(shares), -1, -1), shares),
        refinement=scale_refinement(prediction.refinement, shares),
    )


def scale_refinement(refinement: Refinement, shares: Tensor) -> Refinement:
    """The same corrections of the hand parameters, which learn from each of B frames by its share.

    Args:
        refinement: of B frames.
        shares: (B,) in [0, 1], without gradient.
    """
    return Refinement(
        pose=_by_frame(refinement.pose, shares),
        betas=_by_frame(refinement.betas.expand(len(shares), -1), shares),
        transl=_by_frame(refinement.transl, shares),
    )


def _by_frame(values: Tensor, shares: Tensor) -> Tensor:
    factor = shares.reshape(len(shares), *[1] * (values.ndim - 1)).to(values)
    return _Share.apply(values, factor)
