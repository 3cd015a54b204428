"""Adam with the norm of the gradient clipped."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

import torch
from torch import Tensor

#: A gradient whose norm is beyond this counts as not finite: float32 cannot hold its square, and a
#: second moment that is infinite once would hold a parameter where it is for good.
LARGEST = 1e18


class ClippedAdam(torch.optim.Adam):
    """`torch.optim.Adam`, which clips the norm of the gradient; saved states are the same.

    Args:
        groups: as torch takes them; each may have `clipped`, whether its gradients count in the
            norm and are scaled (true where it is left out). Parameters are float32.
        limit: largest norm; 0 leaves gradients as they are.
        betas: shares of the moments that a step keeps.
        epsilon: added to the root of the second moment.

    Source: Kingma and Ba, "Adam: a method for stochastic optimization".
    """

    def __init__(
        self,
        groups: Iterable[dict[str, Any]],
        limit: float = 0.0,
        *,
        betas: tuple[float, float] = (0.9, 0.99),
        epsilon: float = 1e-15,
    ) -> None:
        super().__init__(list(groups), eps=epsilon, betas=betas, fused=True)
        self.limit = limit

    def add_param_group(self, param_group: dict[str, Any]) -> None:
        """As in torch, without its compiler, which takes two seconds to import and is not used."""
        added = torch.optim.Optimizer.add_param_group
        getattr(added, "__wrapped__", added)(self, param_group)

    def clear(self) -> None:
        """Drop all gradients."""
        for group in self.param_groups:
            for parameter in group["params"]:
                parameter.grad = None

    def take_step(self, loss: Tensor) -> Tensor:
        """Move everything that has a gradient; nothing changes where one or the loss is not finite.

        A tensor whose gradient has a norm beyond `LARGEST` counts as not finite.

        Nobody waits to learn whether it is: torch's fused kernels read that where it lies, as for a
        `GradScaler`, and skip the step.

        Returns:
            1 where nothing has changed, else 0, a scalar on the device.
        """
        gradients = []
        for group in self.param_groups:
            for parameter in group["params"]:
                _lay_out_alike(parameter)
                if parameter.grad is not None and parameter.grad.numel():
                    gradients.append(parameter.grad)
        finite = loss.detach().isfinite()
        if gradients:
            # The largest number would do too, and takes torch ten times as long on the CPU.
            finite = finite & (torch.stack(torch._foreach_norm(gradients)) <= LARGEST).all()
        stopped = (~finite).float()
        if self.limit > 0.0:
            clipped = [group["params"] for group in self.param_groups if group.get("clipped", True)]
            torch.nn.utils.clip_grad_norm_([p for some in clipped for p in some], self.limit)
        with torch.no_grad():
            for group in self.param_groups:
                self._move(group, stopped)
        return stopped

    def _move(self, group: dict[str, Any], stopped: Tensor) -> None:
        """Take one group's step, as `step` does without torch's compiler; none where stopped is 1.

        The first call of `step` imports that compiler, for seconds.
        """
        moved: tuple[list[Tensor], ...] = ([], [], [], [], [], [])
        self._init_group(group, *moved)
        parameters, gradients, means, squares, _, steps = moved
        if not parameters:
            return
        torch._foreach_add_(steps, 1)
        torch._fused_adam_(
            *(parameters, gradients, means, squares, [], steps),
            lr=group["lr"],
            beta1=group["betas"][0],
            beta2=group["betas"][1],
            weight_decay=group["weight_decay"],
            eps=group["eps"],
            amsgrad=False,
            maximize=False,
            grad_scale=None,
            found_inf=stopped,
        )
        torch._foreach_sub_(steps, [stopped] * len(steps))

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        """Continue from a saved state, also one of `torch.optim.Adam` over the same groups."""
        clipped = [group.get("clipped", True) for group in self.param_groups]
        super().load_state_dict(state_dict)
        for group, held in zip(self.param_groups, clipped, strict=True):
            group["clipped"] = held


def _lay_out_alike(parameter: Tensor) -> None:
    """Bring a gradient's numbers into the parameter's order, which the fused kernels rely on."""
    gradient = parameter.grad
    if gradient is not None and gradient.stride() != parameter.stride():
        parameter.grad = torch.empty_like(parameter).copy_(gradient)
