"""Fitting one network to captures of several subjects, for a prior.

Branches and heads are shared, everything else is the captures' own. A run can be stopped and
continues.
"""

from __future__ import annotations

import dataclasses
import shutil
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from hwp_bench.base.errors import UsageError
from hwp_bench.base.files import sha256_json
from hwp_bench.base.folders import exclusive
from hwp_bench.base.records import flattened
from hwp_bench.capture import Capture, open_capture
from hwp_bench.methods.contract import Avatar, Budget, RunSettings, TrainingCapture
from hwp_bench.methods.request import open_request, write_request
from wildghand.fitting.components import make_fit
from wildghand.fitting.fit import Fit
from wildghand.fitting.method import ready_fit
from wildghand.fitting.session import (
    STATE,
    digest_of_request,
    every_frame,
    run_resumed,
    unfinished,
)
from wildghand.gaussians.fit_loop import Loss, batches
from wildghand.model.settings import WildGHandSettings, read_settings
from wildghand.network import PredictionNetwork
from wildghand.plain.loop import IterativeFit
from wildghand.prior.prior import MAPS, Prior, mean_weights, refuse_no_prior, save_prior
from wildghand.splat.threads import denormals_flushed

# Children of a network that belong to its subject.
_OWN = ("identity", "charts")
# Between two steps on a capture others move the texture branch, which they share. The last steps
# are thousands, at low rates: nothing is gained by their mean. All frames but two are fitted, so
# that none is there to choose a state.
_SCHEDULE: Mapping[str, Any] = {"texture_every": 1, "average_share": 0.0, "validated": False}


@denormals_flushed()
def pretrain(
    sources: Sequence[Path],
    out: Path,
    *,
    settings: Mapping[str, Any],
    steps: int | None = None,
    seed: int = 0,
    overwrite: bool = False,
) -> Prior:
    """Fit one network to captures of several subjects, and write it as a prior.

    The state is saved next to `out` every 20 seconds. The same call continues with it after a stop;
    the result is that of a run that was never stopped.

    Args:
        steps: optimizer steps over all captures; None: those of a fit for each capture.

    Raises:
        UsageError: there are too few captures, of several hand models, or a setting is one that
            pretraining decides.
    """
    refuse_no_prior(out)
    if out.exists() and not overwrite:
        raise UsageError("exists", where=out, remedy="Choose another name, or give --overwrite.")
    fixed = {f"schedule.{name}": value for name, value in _SCHEDULE.items()}
    for name, value in flattened(settings):
        if name in fixed and value != fixed[name]:
            raise UsageError(
                f"is {value}, and pretraining has {fixed[name]}", field=name, remedy="Leave it out."
            )
    # A new prior starts from neither the one that ships nor one person's colours, and knows light
    # by itself, unless asked to.
    settings = {
        "prior": "",
        "start_colors": False,
        "shadows.enabled": False,
        # Thousands of steps end with low rates, as those of the shipped prior did.
        "schedule.decay": "geometric",
        **fixed,
        **settings,
    }
    captures = [open_capture(source) for source in sources]
    _check_captures(captures)
    chosen = read_settings(settings)
    run = RunSettings(dict(settings), seed, Budget(steps=steps))
    work = unfinished(out, ".pretrain")
    with exclusive(work):
        weights, done = _fit_in(work, captures, run, chosen)
        prior = save_prior(
            out,
            weights,
            hand_model=captures[0].info.hand_model,
            captures=[_described(capture) for capture in captures],
            settings=chosen,
            seed=seed,
            steps=done,
            overwrite=overwrite,
        )
        shutil.rmtree(work, ignore_errors=True)
    return prior


def _fit_in(
    work: Path, captures: Sequence[Capture], run: RunSettings, chosen: WildGHandSettings
) -> tuple[dict[str, Tensor], int]:
    """Fit, from the state that is saved in the work folder if there is one."""
    requests = [
        write_request(work / f"request-{index}", capture, every_frame(capture), run)
        for index, capture in enumerate(captures)
    ]
    digest = sha256_json(
        [digest_of_request(*each, chosen) for each in zip(requests, captures, strict=True)]
    )
    trainings = [open_request(request) for request in requests]
    joint = JointFit(trainings, chosen, run.seed, ready_fit(chosen.device))
    title = f"Pretraining on {len(captures)} captures"
    return run_resumed(joint, run.budget, work / STATE, digest, title)


def _check_captures(captures: Sequence[Capture]) -> None:
    if len(captures) < 2:
        raise UsageError(
            "one capture makes no prior over subjects",
            field="CAPTURE",
            remedy="Give captures of several people.",
        )
    first = captures[0].info.hand_model
    for capture in captures:
        if capture.info.hand_model.name != first.name:
            raise UsageError(
                f"has the hand model {capture.info.hand_model.name}, the first one {first.name}",
                where=capture.root,
                remedy="Give captures of one hand model.",
            )


def _described(capture: Capture) -> dict[str, Any]:
    """A prior's description of a capture that it was fitted to."""
    info = capture.info.to_json()
    return {
        "id": capture.info.id,
        "hands": capture.info.hands,
        "frames": capture.info.frame_count,
        "digest": sha256_json(info),
        "source": info["source"],
    }


class JointFit(IterativeFit[tuple[dict[str, Tensor], int]]):
    """Fits of several captures that share the weights of branches and heads.

    Each capture keeps its identity map, and what is particular to its frames: perturbation
    biases, gains and poses. A step is a batch of one capture; every capture comes once before
    any comes again.

    Args:
        trainings: what may be seen of each capture.
        settings: how each is fitted.
        seed: of all random numbers.
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
        schedule = dataclasses.replace(settings.schedule, **_SCHEDULE)
        settings = dataclasses.replace(settings, schedule=schedule)
        self.device = device
        self.fits: list[Fit] = []
        for training in trainings:
            fit = make_fit(training, settings, seed, device)
            if self.fits:
                _share(self.fits[0].model.network, fit.model.network)
            self.fits.append(fit)
        _join_optimizers(self.fits)

    def count_steps(self, budget: Budget) -> int:
        """Steps over all captures."""
        if budget.steps is not None:
            return budget.steps
        return sum(fit.count_steps(budget) for fit in self.fits)

    def batches(self) -> Iterator[tuple[int, Tensor]]:
        """Which capture the next step is taken on, and on which of its frames."""
        seed = self.fits[0].seed
        rows = [
            batches(len(fit.data.frames), fit.batch, seed + 1 + index)
            for index, fit in enumerate(self.fits)
        ]
        for capture in batches(len(self.fits), 1, seed):
            yield int(capture[0]), next(rows[int(capture[0])])

    def step(self, batch: tuple[int, Tensor], fraction: float) -> Loss:
        """See `IterativeFit`."""
        capture, rows = batch
        return self.fits[capture].step(rows, fraction)

    def checkpoint(self, steps: int) -> Avatar:
        """The avatar of the first capture."""
        return self.fits[0].avatar(steps)

    def finish(self, steps: int, seconds: float) -> tuple[dict[str, Tensor], int]:
        """The shared weights and the mean identity map of each hand (float32, CPU); the steps."""
        return mean_weights(fit.model.network for fit in self.fits), steps

    def finite(self) -> bool:
        """Whether every fitted number is finite."""
        return all(fit.model.finite() for fit in self.fits)

    def skipped(self) -> int:
        """See `IterativeFit`."""
        return sum(fit.skipped() for fit in self.fits)

    def snapshot(self) -> dict[str, Tensor]:
        """A copy of all models that the fit no longer changes; shared weights are in it once."""
        return {name: value.detach().clone() for name, value in self._tensors().items()}

    @torch.no_grad()
    def restore(self, values: dict[str, Tensor]) -> None:
        """Bring the models back to a snapshot."""
        current = self._tensors()
        if values.keys() != current.keys():
            raise ValueError("tensors of other models")
        for name, value in values.items():
            current[name].copy_(value)

    def state_dict(self) -> dict[str, Any]:
        """Everything that steps change, for `load_state_dict`."""
        return {
            "models": self._tensors(),
            "components": [fit.component_states() for fit in self.fits],
            "steps": [fit.descent.steps for fit in self.fits],
            "skipped": [fit.descent.skipped for fit in self.fits],
            "optimizer": self.fits[0].descent.optimizer.state_dict(),
        }

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Continue from a saved state."""
        self.restore(state["models"])
        own = (state["components"], state["steps"], state["skipped"])
        for fit, parts, steps, skipped in zip(self.fits, *own, strict=True):
            fit.load_component_states(parts)
            fit.descent.steps, fit.descent.skipped = int(steps), skipped
        self.fits[0].descent.optimizer.load_state_dict(state["optimizer"])

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


def _join_optimizers(fits: Sequence[Fit]) -> None:
    """Let all fits share Adam over the parameters of all of them, each once."""
    joint, *others = [fit.descent.optimizer for fit in fits]
    for other in others:
        for group, more in zip(joint.param_groups, other.param_groups, strict=True):
            known = {id(parameter) for parameter in group["params"]}
            group["params"] += [p for p in more["params"] if id(p) not in known]
    for fit in fits:
        fit.descent.optimizer = joint
