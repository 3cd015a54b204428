"""Temporal weights and what a frame teaches.

Where omega starts and what holds it there (`TemporalTarget`), and how much of a frame's gradient
the canonical hand takes (`scale_gradients`).
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor, nn

from wildghand.dpd.dpd import DynamicPerturbation
from wildghand.gaussians.adam import ClippedAdam
from wildghand.gaussians.attributes import RawAttributes
from wildghand.network import NetworkOutput
from wildghand.network.network import Refinement

#: Steps of Adam, and the size of the first, that bring temporal weights to their start.
_STEPS, _RATE = 100, 5e-3
#: A frame that the pre-pass gives less counts as having this.
_LEAST_WEIGHT = 1e-3
#: Frames that one step of the fit looks at, at most.
_LOOKED_AT = 64


@dataclass(frozen=True, eq=False)
class TemporalTarget:
    """Temporal weights that the fit should not stray from.

    Any factor may move from omega to varphi and back without changing a bias. Frames of the same
    severity therefore end at any omega unless something says what it should be.
    """

    #: (R,) in [0, 1) where each frame's omega should be.
    omega: Tensor

    @classmethod
    def judged(cls, frame_weights: Tensor, scale: float, floor: float) -> TemporalTarget:
        """The targets by the pre-pass.

        1 / (1 + beta omega) is the weight of a frame in PAO. With beta = (1 / floor - 1) / scale it
        is here what the pre-pass found.

        Args:
            frame_weights: (R,) the pre-pass's, from the floor to 1.
            scale: omega at the floor.
        """
        span = max(1.0 / max(floor, _LEAST_WEIGHT) - 1.0, 1e-6)
        return cls(scale * (1.0 / frame_weights.clamp(min=_LEAST_WEIGHT) - 1.0) / span)

    def begin(self, modules: Sequence[DynamicPerturbation]) -> None:
        """Bring temporal weights to their targets, and biases to zero.

        Where the targets are zero the module's own start does that. Elsewhere phi and psi are
        fitted to them, and varphi is set to zero: it has a gradient from the first step, because
        omega is not zero.
        """
        if not bool((self.omega > 0.0).any()):
            return
        for module in modules:
            learnt = [*module.phi.parameters(), *module.psi.parameters()]
            optimizer = ClippedAdam(
                [{"params": learnt, "lr": _RATE}], betas=(0.9, 0.999), epsilon=1e-8
            )
            for step in range(_STEPS):
                optimizer.param_groups[0]["lr"] = _RATE * (1.0 - step / _STEPS)
                optimizer.clear()
                distance = self._distance(module, slice(None))
                distance.backward()
                optimizer.take_step(distance)
            for layer in module.varphi.parameters():
                nn.init.zeros_(layer)
            module.zero_grad(set_to_none=True)

    def temporal_loss(self, modules: Sequence[DynamicPerturbation], first: int) -> Tensor:
        """Mean over frames of the squared distance to the target; a sum over hands."""
        stride = math.ceil(len(self.omega) / _LOOKED_AT)
        part = slice(first % stride, None, stride)
        return torch.stack([self._distance(module, part) for module in modules]).sum()

    def _distance(self, module: DynamicPerturbation, part: slice) -> Tensor:
        first, last = module.phi[0], module.phi[2]
        return _Distance.apply(
            first.weight,
            first.bias,
            last.weight,
            last.bias,
            module.psi.weight,
            module.psi.bias,
            module.encoding[: len(self.omega)][part],
            self.omega[part],
        )


class _Distance(torch.autograd.Function):
    """Mean of (omega - target)^2, with its gradient made along with it.

    Between phi's SiLU and omega's sigmoid lie two linear layers, which are one here: a code of
    each frame is not needed, and a step of the fit pays for a row instead of a matrix.
    """

    @staticmethod
    def forward(ctx: Any, *given: Tensor) -> Tensor:
        weight1, bias1, weight2, bias2, psi, psi_bias, codes, target = given
        before = torch.addmm(bias1, codes, weight1.T)
        gate = before.sigmoid()
        hidden = before * gate
        row = psi @ weight2
        omega = ((hidden @ row.T).squeeze(-1) + (psi @ bias2 + psi_bias)).mul_(0.5).tanh_()
        distance = omega - target
        # d omega / d (its argument) = (1 - omega^2) / 2.
        slope = distance * (1.0 - omega.square()) / len(target)
        to_row = slope[None] @ hidden
        to_shift = slope.sum()[None]
        to_before = torch.outer(slope, row[0]) * (gate * (1.0 + before * (1.0 - gate)))
        ctx.save_for_backward(
            to_before.T @ codes,
            to_before.sum(dim=0),
            psi.T @ to_row,
            to_shift * psi[0],
            torch.addmm(to_shift * bias2, to_row, weight2.T),
            to_shift,
        )
        return (distance * distance).mean()

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx: Any, gradient: Tensor) -> tuple[Tensor | None, ...]:
        return (*(made * gradient for made in ctx.saved_tensors), None, None)


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
        shares: (B,) in [0, 1], without gradient.
    """
    return dataclasses.replace(
        prediction,
        raw=RawAttributes(
            **{name: _by_frame(values, shares) for name, values in prediction.raw.items()}
        ),
        shadow=_by_frame(prediction.shadow, shares),
        xi=_by_frame(prediction.xi, shares),
        template_offsets=_by_frame(prediction.template_offsets.expand(len(shares), -1, -1), shares),
        refinement=scale_refinement(prediction.refinement, shares),
    )


def scale_refinement(refinement: Refinement, shares: Tensor) -> Refinement:
    """The same corrections of the hand parameters, which learn from each of B frames by its share.

    Args:
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
