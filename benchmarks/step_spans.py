"""Which component of a step each piece of its code belongs to, told to torch's profiler.

While `marked` holds, the functions listed here open a span of the profiler. What they do not cover
is counted for the span around it.
"""

from __future__ import annotations

import functools
import importlib
from collections.abc import Callable, Generator, Iterator
from contextlib import contextmanager
from typing import Any

import torch
from torch.profiler import record_function

#: What spans of components and of passes begin with.
COMPONENT, PASS = "component: ", "pass: "
#: Code that no other component claims.
OTHER = "other"

#: Functions by component, as `module:name`.
FUNCTIONS: dict[str, tuple[str, ...]] = {
    "network: texture": ("wildghand.network.network:PredictionNetwork.texture",),
    "network: coder": ("wildghand.network.branches:PlaneCoder.forward",),
    "network: geometry": ("wildghand.network.network:PredictionNetwork.geometry",),
    "network: shared": (
        "wildghand.network.network:PredictionNetwork.features",
        "wildghand.fitting.descent:SharedFeatures._share_out",
    ),
    "network: heads": ("wildghand.network.network:PredictionNetwork.forward",),
    "hand poses": (
        "wildghand.gaussians.training:TrainingClip.hand",
        "wildghand.gaussians.training:TrainingClip.poses",
        "wildghand.gaussians.rig:HandRig.follow",
        "wildghand.gaussians.rig:HandRig.pose",
    ),
    "DPD": (
        "wildghand.dpd.dpd:DynamicPerturbation.temporal",
        "wildghand.dpd.dpd:DynamicPerturbation.layer",
        "wildghand.model.model:scale_refinement",
    ),
    "placing": (
        "wildghand.model.model:dress",
        "wildghand.gaussians.attributes:AnchoredGaussians.place",
    ),
    "shading": ("wildghand.plain.model:sh_basis",),
    "rasterizer": (
        "wildghand.model.model:rasterize_hands",
        "wildghand.model.frames:rasterize",
        "wildghand.plain.model:rasterize",
    ),
    "photometric loss": (
        "wildghand.model.terms:reconstruction",
        "wildghand.plain.recipe:photometric_loss",
    ),
    "regularisers": (
        "wildghand.fitting.objective:Regularisers.loss",
        "wildghand.fitting.disentangle:Dpd.loss",
        "wildghand.fitting.objective:Regularisers.loss_of_features",
    ),
    "shadows": ("wildghand.fitting.light:Lighting.draws", "wildghand.model.model:dimmed"),
    "PAO": ("wildghand.fitting.weights:Pao.compare",),
    "targets and weights": ("wildghand.gaussians.training:FrameTable.__call__",),
    "mean of the steps": ("wildghand.fitting.choice:AveragedSteps.after_step",),
    "optimizer": (
        "torch.optim.optimizer:Optimizer.zero_grad",
        "wildghand.gaussians.adam:ClippedAdam.clear",
        "wildghand.gaussians.adam:ClippedAdam.take_step",
        "wildghand.fitting.descent:Descent.set_rates",
    ),
}


@contextmanager
def marked() -> Iterator[None]:
    """Mark components and passes while this holds."""
    undo: list[Callable[[], None]] = []
    try:
        for component, places in FUNCTIONS.items():
            for place in places:
                _mark(place, COMPONENT + component, undo)
        _mark("torch.autograd:backward", PASS + "backward", undo)
        yield
    finally:
        for restore in reversed(undo):
            restore()


def _mark(place: str, span: str, undo: list[Callable[[], None]]) -> None:
    module, _, path = place.partition(":")
    *owners, name = path.split(".")
    owner = functools.reduce(getattr, owners, importlib.import_module(module))
    original = getattr(owner, name)

    @functools.wraps(original)
    def inside(*args: Any, **kwargs: Any) -> Any:
        with record_function(span):
            found = original(*args, **kwargs)
            return list(found) if isinstance(found, Generator) else found

    setattr(owner, name, inside)
    undo.append(lambda: setattr(owner, name, original))


def component_of(event: str) -> str | None:
    """The component that an event of the profiler opens; None for one that opens none."""
    if event.startswith(COMPONENT):
        return event.removeprefix(COMPONENT)
    # Torch opens this span itself, in whatever optimizer.
    return "optimizer" if event.startswith("Optimizer.step#") else None


def profiled() -> Any:
    """A profiler of this process's threads (CPU)."""
    return torch.profiler.profile(activities=[torch.profiler.ProfilerActivity.CPU])
