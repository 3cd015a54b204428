"""How much of a frame's gradient the canonical hand takes."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from wildghand.attributes import RawAttributes
from wildghand.network import Prediction
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


@dataclass(frozen=True, eq=False)
class Shares:
    """How much the canonical hand learns from each of B frames."""

    #: (B,) in [0, 1]: what moves the hand as a whole.
    frames: Tensor
    #: By side (B, N) in [0, 1]: the attributes of each Gaussian.
    places: Mapping[str, Tensor]


def place_shares(frame_weights: Tensor, views: Tensor, least_views: float) -> Tensor:
    """How much each Gaussian learns from each frame.

    A place that good frames show learns from these. One that they do not show would never be
    learnt: there the weights are raised, in proportion, until the frames that show it are worth
    `least_views` clean ones, or count in full.

    Args:
        frame_weights: (B,) in (0, 1].
        views: (N,) sum of the weights of all frames that show the place.
        least_views: frames; 0 leaves the weights as they are.

    Returns:
        (B, N) in (0, 1].
    """
    raised = (least_views / views.clamp_min(1e-6)).clamp_min(1.0)
    return (frame_weights[:, None] * raised).clamp_max(1.0)


def taught(prediction: Prediction, frames: Tensor, places: Tensor) -> Prediction:
    """The same prediction, which learns from each of B frames by its share.

    What belongs to a frame alone (biases, gain, pose) still learns from all of its gradient: a
    perturbed frame is explained by what is particular to it and leaves the hand alone. Weighing
    the frame's loss instead would silence both.

    Args:
        prediction: of B frames.
        frames: (B,) in [0, 1], without gradient: for what moves the hand as a whole.
        places: (B, N) in [0, 1], without gradient: for the attributes of each Gaussian.
    """
    count = len(frames)
    by_place = places[..., None]

    def by_frame(values: Tensor) -> Tensor:
        factor = frames.reshape(count, *[1] * (values.ndim - 1)).to(values)
        return _Share.apply(values, factor)

    def by_gaussian(values: Tensor) -> Tensor:
        return _Share.apply(values, by_place.to(values))

    refinement = prediction.refinement
    return dataclasses.replace(
        prediction,
        raw=RawAttributes(**{name: by_gaussian(values) for name, values in prediction.raw.items()}),
        shadow=by_gaussian(prediction.shadow),
        template_offsets=by_gaussian(prediction.template_offsets.expand(count, -1, -1)),
        refinement=Refinement(
            pose=by_frame(refinement.pose),
            betas=by_frame(refinement.betas.expand(count, -1)),
            transl=by_frame(refinement.transl),
        ),
    )
