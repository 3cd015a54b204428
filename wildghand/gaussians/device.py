"""Where a fit runs."""

from __future__ import annotations

import importlib.util

import torch

from hwp_bench.base.errors import MissingDependency


def choose_device(name: str) -> torch.device:
    """Resolve `auto`, `cpu` or `cuda`; `auto` is CUDA where both a GPU and gsplat are there.

    Raises:
        MissingDependency: CUDA was asked for and is not there.
    """
    if name == "cpu":
        return torch.device("cpu")
    ready = torch.cuda.is_available() and importlib.util.find_spec("gsplat") is not None
    if name == "cuda" and not ready:
        raise MissingDependency(
            "a CUDA GPU and the package gsplat are not both there",
            field="device",
            remedy="Use device = auto or cpu, or install the extra `cuda`.",
        )
    return torch.device("cuda" if ready else "cpu")
