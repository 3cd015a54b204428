"""Kernels are made ready before a fit; oracle: which versions numba holds after it."""

from __future__ import annotations

import sys
from collections.abc import Callable

import torch

from hwp_bench.methods.contract import TrainingCapture
from wildghand.fitting.fit import Fit
from wildghand.fitting.ready import ready_fit
from wildghand.model.settings import read_settings


def versions() -> dict[str, int]:
    """How many versions of each compiled function of the toolkit this process holds."""
    found = {}
    for name, module in list(sys.modules.items()):
        if name.split(".")[0] in ("wildghand", "hwp_bench"):
            for attribute, value in list(vars(module).items()):
                dispatcher = getattr(value, "dispatcher", value)
                if hasattr(dispatcher, "nopython_signatures"):
                    found[f"{name}.{attribute}"] = len(dispatcher.nopython_signatures)
    return found


def test_a_step_compiles_nothing(make_training: Callable[..., TrainingCapture]) -> None:
    device = ready_fit("cpu")
    settings = read_settings({"gaussians": 600, "device": "cpu"})
    fit = Fit(make_training(), settings, 0, device)
    before = versions()
    assert sum(before.values()) > 20
    for _ in range(2 * settings.schedule.texture_every):
        fit.step(torch.tensor([0]), 0.9)
    after = {name: count for name, count in versions().items() if count}
    assert after == {name: count for name, count in before.items() if count}
