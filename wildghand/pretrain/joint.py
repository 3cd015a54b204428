"""A fit of several captures at once: shared branches and heads, everything else their own."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Sequence
from typing import Any

import torch
from torch import Tensor

from hwp_bench.base.console import notice
from hwp_bench.methods.contract import TrainingCapture
from wildghand.fitting.fit import Fit
from wildghand.fitting.optimize import Watchers
from wildghand.fitting.rates import make_optimizer
from wildghand.gaussians.adam import ClippedAdam
from wildghand.gaussians.fit_loop import Loss, batches
from wildghand.model.settings import WildGHandSettings
from wildghand.network import PredictionNetwork
from wildghand.prior.prior import MAPS, mean_weights

# Children of a network that belong to its subject.
_OWN = ("identity", "charts")


class JointFit:
    """Fits of several captures that share the weights of branches and heads.

    Each capture keeps its identity map, and what is particular to its frames: perturbation
    biases, gains and poses. A step is a batch of one capture; every capture comes once before
    any comes again.

    Args:
        trainings: what may be seen of each capture.
        settings: how each is fitted.
        seed: of everything random.
        device: where it runs.

    Raises:
        BadInput: a capture has no training frame that can be used.
    """

    def __init__(
        self,
        trainings: Sequence[TrainingCapture],
        settings: WildGHandSettings,
        seed: int,
        device: torch.device,
    ) -> None:
        # Between two steps on a capture others move the texture branch, which they share. Its last
        # steps are thousands, at low rates: nothing is gained by their mean. All of its frames are
        # fitted, so that none is there to choose a state.
        schedule = dataclasses.replace(
            settings.schedule, texture_every=1, average_share=0.0, validated=False
        )
        settings = dataclasses.replace(settings, schedule=schedule)
        self.settings = settings
        self.device = device
        self.fits: list[Fit] = []
        for training in trainings:
            fit = Fit(training, settings, seed, device)
            if self.fits:
                _share(self.fits[0].model.network, fit.model.network)
            self.fits.append(fit)
        self.optimizer = _joint_optimizer(self.fits)
        for fit in self.fits:
            fit.optimizer = self.optimizer
        self._captures = batches(len(self.fits), 1, seed)
        self._rows = [
            batches(len(fit.frames), settings.schedule.batch, seed + 1 + index)
            for index, fit in enumerate(self.fits)
        ]

    def step(self, fraction: float) -> Loss:
        """Take one step on a batch of the next capture.

        Args:
            fraction: share of the steps that are done.

        Returns:
            The loss; nothing is changed where it is not finite.
        """
        capture, rows = self._next()
        return self.fits[capture].step(rows, fraction)

    def skip(self, steps: int) -> None:
        """Pass over the batches of steps that were taken before."""
        for _ in range(steps):
            self._next()

    def weights(self) -> dict[str, Tensor]:
        """The shared weights and the mean identity map of each hand; float32, CPU."""
        return mean_weights(fit.model.network for fit in self.fits)

    def finite(self) -> bool:
        """Whether every fitted number is finite."""
        return all(fit.model.finite() for fit in self.fits)

    def snapshot(self) -> dict[str, Tensor]:
        """A copy of all models that the fit no longer changes; shared weights are in it once."""
        return {name: value.detach().clone() for name, value in self._tensors().items()}

    def restore(self, snapshot: dict[str, Tensor]) -> None:
        """Bring the models back to a snapshot.

        Raises:
            ValueError: it is one of other models.
        """
        current = self._tensors()
        if snapshot.keys() != current.keys():
            raise ValueError("tensors of other models")
        with torch.no_grad():
            for name, value in snapshot.items():
                current[name].copy_(value)

    def state_dict(self) -> dict[str, Any]:
        """Everything that steps change, for `load_state_dict`."""
        return {
            "models": self._tensors(),
            "weightings": [fit.weighting.state_dict() for fit in self.fits],
            "generators": [fit.generator.get_state() for fit in self.fits],
            "steps": [fit.steps for fit in self.fits],
            "optimizer": self.optimizer.state_dict(),
        }

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Go on from a saved state."""
        self.restore(state["models"])
        parts = zip(self.fits, state["weightings"], state["generators"], strict=True)
        for fit, weighting, generator in parts:
            fit.weighting.load_state_dict(weighting)
            fit.generator.set_state(generator.cpu())
        # States of before have none: their rates did not depend on them.
        for fit, steps in zip(self.fits, state.get("steps", [0] * len(self.fits)), strict=True):
            fit.steps = int(steps)
        self.optimizer.load_state_dict(state["optimizer"])

    def _next(self) -> tuple[int, Tensor]:
        capture = int(next(self._captures)[0])
        return capture, next(self._rows[capture])

    def _tensors(self) -> dict[str, Tensor]:
        """The tensors of all models by capture and name; shared ones under the first capture."""
        tensors = {}
        for index, fit in enumerate(self.fits):
            for name, value in fit.model.state_dict().items():
                shared = name.startswith("network.") and not name.startswith(f"network.{MAPS}")
                if index == 0 or not shared:
                    tensors[f"{index}.{name}"] = value
        return tensors


def _share(source: PredictionNetwork, network: PredictionNetwork) -> None:
    """Make a network use another one's branches and heads."""
    for name, child in source.named_children():
        if name not in _OWN:
            setattr(network, name, child)


def _joint_optimizer(fits: Sequence[Fit]) -> ClippedAdam:
    """Adam over the parameters of all fits, each of them once; rates by group as in a fit."""
    joint, *others = [make_optimizer(fit.model, fit.weighting.pao, fit.settings) for fit in fits]
    for other in others:
        for group, more in zip(joint.param_groups, other.param_groups, strict=True):
            known = {id(parameter) for parameter in group["params"]}
            group["params"] += [p for p in more["params"] if id(p) not in known]
    return joint


def take_steps(
    joint: JointFit,
    steps: int,
    watchers: Watchers,
    *,
    start: int = 0,
    after_step: Callable[[int], None] | None = None,
) -> int:
    """Take steps until all are taken, the loss stands still, or the fit diverges.

    Args:
        joint: what is fitted.
        steps: how many, those before `start` included.
        watchers: of the loss, so far.
        start: steps that `joint` has behind it.
        after_step: called with the number of steps after each; saves, for instance.

    Returns:
        Steps behind the state of `joint`: the last one, or the best one if the fit diverged.

    Raises:
        DidNotConverge: the fit diverged without ever having been better than its start.
    """
    joint.skip(start)
    for step in range(start, steps):
        loss = joint.step(step / steps)
        if not watchers.guard.watch(step, loss, joint):
            joint.restore(watchers.guard.best())
            kept = watchers.guard.step
            notice(f"The fit diverged at step {step}; the state of step {kept} is kept.")
            return kept
        if after_step is not None:
            after_step(step + 1)
        if watchers.plateau.reached(loss):
            notice(f"The loss stands still after {step + 1} steps; finished early.")
            return step + 1
    return steps
