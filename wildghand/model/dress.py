"""From what the network predicts to Gaussians in the world: bias, activation, motion.

On the CPU, in float32, one compiled pass each way takes one Gaussian at a time, on all threads;
elsewhere torch does. A test compares both in float64.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from torch import Tensor

from wildghand.dpd.dpd import FramePerturbation
from wildghand.dpd.temporal import scale_gradients
from wildghand.gaussians.attributes import CHANNELS, Activation
from wildghand.gaussians.quaternions import quat_multiply, quat_rotate
from wildghand.gaussians.rig import AnchorPoses
from wildghand.model.dress_kernels import PIECE, dress_pieces, dress_pieces_backward
from wildghand.model.terms import bias_size
from wildghand.network import NetworkOutput
from wildghand.splat.threads import kernels_take, piece_count, run_pieces

#: A Gaussian here takes as long as so many of those that `thread_count` counts.
_WEIGHT = 4


def dress_cpu(
    anchors: AnchorPoses,
    prediction: NetworkOutput,
    activation: Activation,
    perturbation: FramePerturbation | None,
    shares: Tensor | None,
) -> tuple[tuple[Tensor, ...], Tensor | None]:
    """See `wildghand.model.dress.dress`."""
    raw = prediction.raw.concatenate()
    frames = len(raw)
    ones = torch.ones(frames)
    mixing, shift = raw.new_zeros(CHANNELS, CHANNELS), raw.new_zeros(frames, CHANNELS)
    field = raw.new_zeros(frames, 0, CHANNELS)
    omega, biased = ones, torch.zeros(frames, dtype=torch.bool)
    if perturbation is not None:
        mixing, shift = perturbation.module.layer(perturbation.temporal.z)
        omega, kept = perturbation.temporal.omega, perturbation.kept
        field = field if perturbation.field is None else perturbation.field
        biased = torch.ones(frames, dtype=torch.bool) if kept is None else kept
    *made, size = _Dress.apply(
        raw,
        mixing,
        shift,
        field,
        omega,
        prediction.template_offsets,
        prediction.shadow,
        anchors.positions,
        anchors.orientations,
        biased,
        ones if shares is None else shares,
        activation,
    )
    return tuple(made), None if perturbation is None else size


class _Dress(torch.autograd.Function):
    """Arguments as `dress_cpu` gives them; the last four have no gradient."""

    @staticmethod
    def forward(
        ctx: Any,
        raw: Tensor,
        mixing: Tensor,
        shift: Tensor,
        field: Tensor,
        omega: Tensor,
        moved: Tensor,
        shadow: Tensor,
        positions: Tensor,
        orientations: Tensor,
        biased: Tensor,
        shares: Tensor,
        activation: Activation,
    ) -> tuple[Tensor, ...]:
        """Return the five tensors of the Gaussians, and the mean size of the biases."""
        frames, count = raw.shape[:2]
        given = [_array(t) for t in (raw, mixing, shift, field, omega, biased)]
        made = [torch.empty(frames, count, k) for k in (12, 3, 4, 3)]
        made += [torch.empty(frames, count), torch.empty(frames, count, 3)]
        sizes = np.zeros(piece_count(count, PIECE))
        run_pieces(
            dress_pieces,
            count,
            PIECE,
            _WEIGHT * frames * count,
            *given,
            np.float32(activation.max_offset),
            np.array(
                [
                    activation.log_scale_bias,
                    math.log(activation.min_scale),
                    math.log(activation.max_scale),
                ],
                np.float32,
            ),
            *(_array(t) for t in (moved, shadow.squeeze(-1), positions, orientations)),
            *(tensor.numpy() for tensor in made),
            sizes,
        )
        active, means, quats, scales, opacities, colors = made
        ctx.save_for_backward(
            raw, mixing, shift, field, omega, biased, shares, shadow, orientations, active,
            scales, opacities,
        )  # fmt: skip
        ctx.max_offset = activation.max_offset
        size = torch.tensor(sizes.sum() / max(1, frames * count), dtype=torch.float32)
        return means, quats, scales, opacities, colors, size

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx: Any, *gradients: Tensor) -> tuple[Tensor | None, ...]:
        """Gradients of all that have one."""
        raw, mixing, shift, field, omega, biased, shares, shadow, *rest = ctx.saved_tensors
        frames, count = raw.shape[:2]
        pieces = piece_count(count, PIECE)
        of_raw, of_moved = torch.empty_like(raw), torch.empty(count, 3)
        of_shadow, of_field = torch.empty(frames, count), torch.empty_like(field)
        of_mixing = torch.zeros(pieces, CHANNELS, CHANNELS)
        of_shift, of_omega = torch.zeros(pieces, frames, CHANNELS), torch.zeros(pieces, frames)
        run_pieces(
            dress_pieces_backward,
            count,
            PIECE,
            _WEIGHT * frames * count,
            *(_array(t) for t in (raw, mixing, shift, field, omega, biased, shares)),
            np.float32(ctx.max_offset),
            _array(shadow.squeeze(-1)),
            *(_array(t) for t in (*rest, *gradients[:-1])),
            np.float32(float(gradients[-1]) / max(1, frames * count)),
            *(
                t.numpy()
                for t in (of_raw, of_moved, of_shadow, of_mixing, of_shift, of_field, of_omega)
            ),
        )
        return (
            of_raw,
            of_mixing.sum(dim=0),
            of_shift.sum(dim=0),
            of_field,
            of_omega.sum(dim=0),
            of_moved,
            of_shadow[..., None],
            gradients[0],
            *(None,) * 4,
        )


def _array(tensor: Tensor) -> np.ndarray:
    return tensor.detach().contiguous().numpy()


@dataclass(frozen=True, eq=False)
class Gaussians:
    """Gaussians in B frames, as `wildghand.splat.rasterize` takes them."""

    #: (B, N, 3) m, world.
    means: Tensor
    #: (B, N, 4) of length 1, world.
    quats: Tensor
    #: (N, 3) or (B, N, 3) m.
    scales: Tensor
    #: (N,) or (B, N) in (0, 1).
    opacities: Tensor
    #: (B, N, 3) sRGB.
    colors: Tensor


def dress(
    anchors: AnchorPoses,
    prediction: NetworkOutput,
    activation: Activation,
    perturbation: FramePerturbation | None = None,
    shares: Tensor | None = None,
) -> tuple[Gaussians, Tensor | None]:
    """Bring the Gaussians of one hand into the world.

    p' = p_g + v': the predicted offset from the vertex that heads iii and iv moved.

    Args:
        perturbation: of the frames; None: they have no biases.
        shares: (B,) how much `prediction` learns from each frame; None: all.
    """
    if kernels_take(anchors.positions, prediction.raw.offsets, prediction.shadow):
        made, size = dress_cpu(anchors, prediction, activation, perturbation, shares)
        return Gaussians(*made), size
    if shares is not None:
        prediction = scale_gradients(prediction, shares)
    raw, size = prediction.raw, None
    if perturbation is not None:
        biases = perturbation.biases(raw)
        raw, size = raw + biases, bias_size(biases)
    attributes = activation(raw)
    offsets = attributes.offsets + prediction.template_offsets
    gaussians = Gaussians(
        means=anchors.positions + quat_rotate(anchors.orientations, offsets),
        quats=quat_multiply(anchors.orientations, attributes.quats),
        scales=attributes.scales,
        opacities=attributes.opacities,
        colors=attributes.colors * prediction.shadow,
    )
    return gaussians, size
