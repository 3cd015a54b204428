"""How a fit descends: Adam over everything, how its rates fall, texture features steps share."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping
from typing import Any

import torch
from torch import Tensor

from wildghand.fitting.parallel import World, average_gradients
from wildghand.gaussians.adam import ClippedAdam
from wildghand.gaussians.fit_loop import repeatable
from wildghand.model.model import WildGHandModel
from wildghand.model.settings import ScheduleSettings
from wildghand.network import HandFeatures, PredictionNetwork, parameter_groups

Features = Mapping[str, HandFeatures]

# Adam's steps at the start: the latent identity map, the matrix that adds it to the attributes, the
# linear part of the shadow head, head iv, the other layers, and DPD. They are chosen for fits of a
# minute (docs/studies/dpd-pao.md).
_RATES = {
    "identity": 0.015,
    "direct": 1e-3,
    "light": 0.01,
    "refinement": 1e-3,
    "network": 0.01,
    "dpd": 1e-3,
}
# The paper's, for days: one for everything but the thresholds, halved every five epochs.
_PUBLISHED_RATE, _HALVED_AFTER = 1e-4, 5
# Thresholds of PAO, which drift away at higher rates; log gain, pose (rad) and translation (m) of
# each frame.
_OTHER_RATES = {"thresholds": 1e-6, "gains": 0.01, "pose": 5e-4, "transl": 5e-5}
# Norm that the gradient is clipped to: single frames with a wrong pose would throw a fit off.
_CLIP = 1.0
# Rates at the end as a share of those at the start: where a mean of steps follows, and where the
# last step is kept. After t steps those of the first are also divided by sqrt(1 + t / 200).
_ROOT, _ROOT_STEPS, _GEOMETRIC = 0.3, 200.0, 0.05


class Descent:
    """Steps of Adam.

    Args:
        model: everything of it that is fitted moves.
        others: what moves besides, by the name of its rate; ours does not clip it.
        schedule: rates.
        terms: of the loss that no frame enters, see `SharedFeatures`.
        epoch: steps that look at as many frames as there are.

    Attributes:
        optimizer: several fits may share it.
        shared: texture features of the steps of a block.
        steps: that were taken.
        skipped: those of them in which a gradient was not finite, so that nothing moved; on the
            device.
    """

    def __init__(
        self,
        model: WildGHandModel,
        others: Mapping[str, Iterable[Tensor]],
        schedule: ScheduleSettings,
        terms: Callable[[Features], Tensor | None],
        epoch: float,
    ) -> None:
        self.optimizer = make_optimizer(model, others, schedule)
        self.shared = SharedFeatures(model.network, schedule.texture_every, terms)
        self.steps = 0
        self._schedule, self._epoch = schedule, epoch
        self._device = model.log_gains.device
        self.skipped = torch.zeros((), device=self._device)

    def set_rates(self, fraction: float) -> None:
        """Set the rates of all groups for a step; see `rate_factor`."""
        factor = rate_factor(self._schedule, fraction, self.steps, self._epoch)
        for group in self.optimizer.param_groups:
            group["lr"] = group["start"] * factor

    def take(self, loss: Tensor, mean: Tensor, world: World) -> None:
        """Take a step."""
        self.optimizer.clear()
        with repeatable(self._device):
            waiting = self.shared.backward(loss, mean)
        average_gradients(self.tensors(), world)
        if self._schedule.rates == "released":
            for gradient in (tensor.grad for tensor in self.tensors()):
                if gradient is not None:
                    gradient.nan_to_num_(0.0, 0.0, 0.0)
        self.skipped = self.skipped + self.optimizer.take_step(waiting)
        self.steps += 1

    def tensors(self) -> list[Tensor]:
        """Everything that moves."""
        return [tensor for group in self.optimizer.param_groups for tensor in group["params"]]

    def state_dict(self) -> dict[str, Any]:
        """The state for `load_state_dict`."""
        return {
            "optimizer": self.optimizer.state_dict(),
            "shared": self.shared.state_dict(),
            "steps": self.steps,
            "skipped": self.skipped,
        }

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Continue from a saved state; the model's must be loaded before."""
        self.optimizer.load_state_dict(state["optimizer"])
        self.shared.load_state_dict(state["shared"])
        self.steps, self.skipped = int(state["steps"]), state["skipped"]


def make_optimizer(
    model: WildGHandModel, others: Mapping[str, Iterable[Tensor]], schedule: ScheduleSettings
) -> ClippedAdam:
    """Adam over everything that is fitted; each group keeps its first rate as `start`."""
    groups: dict[str, list[Tensor]] = {
        name: [*group] for name, group in parameter_groups(model.network).items()
    }
    groups["dpd"] = list(model.perturbation.parameters())
    groups |= {name: list(group) for name, group in others.items()}
    groups["gains"] = [model.log_gains] if model.log_gains.requires_grad else []
    groups["pose"] = [model.pose_steps]
    groups["transl"] = [model.transl_steps]
    fast = schedule.rates == "fast"
    rates = (_RATES if fast else dict.fromkeys(_RATES, _PUBLISHED_RATE)) | _OTHER_RATES
    constants: dict[str, Any] = {} if fast else {"betas": (0.9, 0.999), "epsilon": 1e-8}
    return ClippedAdam(
        [
            {
                "params": group,
                "lr": rates[name],
                "start": rates[name],
                "clipped": not fast or name not in others,
            }
            for name, group in groups.items()
            if group
        ],
        _CLIP,
        **constants,
    )


def rate_factor(schedule: ScheduleSettings, fraction: float, steps: int, epoch: float) -> float:
    """Factor on the first rates in a step."""
    if schedule.rates != "fast":
        return 0.5 ** int(steps / (_HALVED_AFTER * epoch))
    if schedule.decay == "geometric":
        return _GEOMETRIC**fraction
    return _ROOT**fraction / math.sqrt(1.0 + steps / _ROOT_STEPS)


class SharedFeatures:
    """Features of the hands, evaluated once for a block of steps.

    Texture features do not depend on the frame. So the steps of a block draw different frames of
    one evaluation of them, as the frames of a batch would. Their gradients are added up, and at
    the end of the block the texture branch takes the mean, once. Everything else moves at every
    step, also the identity map through the direct path.

    Args:
        network: it predicts the features.
        every: steps of a block; 1: nothing is shared.
        terms: of the loss that no frame enters, see `Component.loss_of_features`.

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
        """The backward pass of a step; at the end of a block also that of the features."""
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
        """Continue from a saved state; the network's own must be loaded before."""
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
