"""A step of a fit on a device: nobody waits for the device.

Oracle without a GPU: torch's device `meta`, whose tensors have no values. Whatever reads a value
raises there, and modes that see every operation note copies that would wait. The code that runs is
that of CUDA. With a GPU: torch's own debug mode, which raises where the host waits.
"""

from __future__ import annotations

import dataclasses
import sys
from typing import Any

import numpy as np
import pytest
import torch
from odd_fits import part
from painted import TrainingMaker
from torch.overrides import TorchFunctionMode
from torch.utils import _pytree
from torch.utils._python_dispatch import TorchDispatchMode

from hwp_bench.methods.contract import TrainingCapture
from wildghand.fitting.components import make_fit
from wildghand.fitting.descent import Descent
from wildghand.fitting.disentangle import Dpd
from wildghand.fitting.fit import Fit
from wildghand.fitting.judging import HiddenSkin
from wildghand.fitting.light import Lighting
from wildghand.fitting.objective import Regularisers
from wildghand.fitting.weights import MaskWeights, Pao
from wildghand.gaussians.fit_loop import batches, choose_device, ready_device
from wildghand.model.settings import read_settings
from wildghand.plain.loop import Watchers

FAKE = torch.device("meta")
HAS_GPU = choose_device("auto").type == "cuda"
QUICK: dict[str, Any] = {
    "gaussians": 200,
    "network.identity_resolution": 40,
    "network.plane_resolution": 20,
}
VARIANTS: dict[str, dict[str, Any]] = {
    "default": {},
    "two hands": {},
    "paper": {"mode": "paper"},
    "released": {"mode": "released"},
    "released, two hands": {"mode": "released"},
    "binary": {"pao.variant": "binary"},
    "bare": {"dpd.enabled": False, "pao.enabled": False, "heads": False},
    "batch of 4": {"schedule.batch": 4},
    "perceptual": {"terms.perceptual": 0.1, "terms.weights": "paper"},
}


class Waits(TorchDispatchMode):
    """Notes every operation for which the host would wait for the device.

    Attributes:
        found: their names.
    """

    def __init__(self) -> None:
        super().__init__()
        self.found: list[str] = []

    def __torch_dispatch__(
        self, func: Any, types: Any, args: Any = (), kwargs: dict[str, Any] | None = None
    ) -> Any:
        kwargs = kwargs or {}
        given = [t for t in _pytree.tree_leaves((args, kwargs)) if isinstance(t, torch.Tensor)]
        result = func(*args, **kwargs)
        made = [t for t in _pytree.tree_leaves(result) if isinstance(t, torch.Tensor)]
        # A scalar of the host is handed over with the call; everything else is copied.
        kinds = {t.device.type for t in (*given, *made) if t.dim() or t.device == FAKE}
        name = str(func)
        if len(kinds) > 1 and not _queued(name, args, kwargs):
            self.found.append(name)
        return result


class HandedOver(TorchFunctionMode):
    """Notes numbers of the host that are made a tensor of the device, for which it waits.

    On the device `meta` they need no copy, so that `Waits` does not see them.

    Attributes:
        found: names of the calls.
    """

    def __init__(self) -> None:
        super().__init__()
        self.found: list[str] = []

    def __torch_function__(
        self, func: Any, types: Any, args: Any = (), kwargs: dict[str, Any] | None = None
    ) -> Any:
        result = func(*args, **(kwargs or {}))
        name = func.__name__
        made = name in ("new_tensor", "tensor", "as_tensor") and result.device == FAKE
        if made and not isinstance(args[-1], torch.Tensor):
            self.found.append(name)
        if name in ("__getitem__", "__setitem__") and args[0].device == FAKE:
            index = args[1] if isinstance(args[1], tuple) else (args[1],)
            if any(isinstance(part, list | np.ndarray) for part in index):
                self.found.append(name)
        return result


def _queued(name: str, args: Any, kwargs: dict[str, Any]) -> bool:
    if name == "aten._to_copy.default":
        return bool(kwargs.get("non_blocking"))
    return name == "aten.copy_.default" and bool(args[2:] and args[2])


def moved(value: Any) -> Any:
    """The same on the fake device; objects that are not dataclasses are changed."""
    if isinstance(value, torch.Tensor):
        dense = value.to_dense() if value.layout != torch.strided else value
        return torch.empty_like(dense, device=FAKE)
    if isinstance(value, torch.nn.Module):
        return value.to(FAKE)
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        changes = {
            item.name: moved(getattr(value, item.name)) for item in dataclasses.fields(value)
        }
        return dataclasses.replace(value, **changes)
    if isinstance(value, dict):
        return {name: moved(part) for name, part in value.items()}
    if isinstance(value, tuple) and not hasattr(value, "_fields"):
        return tuple(moved(part) for part in value)
    if type(value).__module__.startswith("wildghand"):
        vars(value).update({name: moved(part) for name, part in vars(value).items()})
    return value


def fake_fit(training: TrainingCapture, changes: dict[str, Any]) -> Fit:
    """A fit that was made on the CPU and then brought to the fake device."""
    settings = read_settings({**QUICK, "device": "cpu", **changes})
    fit = make_fit(training, settings, 0, torch.device("cpu"))
    fit.device = fit.data.device = FAKE
    for name in ("images", "masks", "whole_images", "silhouettes"):
        vars(fit.data).pop(name, None)
    fit.model = fit.model.to(FAKE)
    fit.model.rigs = moved(fit.model.rigs)
    fit.clip = moved(fit.clip)
    fit.clip._rigs = fit.model.rigs
    held = fit.part(Dpd)
    if held is not None:
        held.temporal = moved(held.temporal)
    smooth = part(fit, Regularisers)
    smooth._laplacians = moved(smooth._laplacians)
    if fit.model.shadows is not None:
        for name in ("_corners", "_directions", "_strengths"):
            setattr(fit.model.shadows, name, moved(getattr(fit.model.shadows, name)))
        table = part(fit, Lighting)._table
        assert table is not None
        table._device = FAKE
    for kind in (HiddenSkin, Pao, MaskWeights):
        found = fit.part(kind)
        if found is not None:
            found.before(fit)
    others = {name: group for c in fit.components for name, group in c.parameters().items()}
    fit.descent = Descent(fit.model, others, settings.schedule, fit._loss_of_features, fit.epoch)
    return fit


def stand_in(
    means: torch.Tensor,
    quats: torch.Tensor,
    scales: torch.Tensor,
    opacities: torch.Tensor,
    colors: torch.Tensor,
    viewmats: torch.Tensor,
    Ks: torch.Tensor,
    width: int,
    height: int,
) -> tuple[torch.Tensor, torch.Tensor, dict[str, Any]]:
    """Images of the right shape with gradients to everything that a rasterizer has them to."""
    depends = means.sum() + quats.sum() + scales.sum() + opacities.sum() + colors.sum()
    images = (depends + Ks.sum() + viewmats.sum()).expand(len(viewmats), height, width, 3)
    return images, images[..., :1], {}


@pytest.fixture
def fake_device(monkeypatch: pytest.MonkeyPatch) -> None:
    """Torch's fused Adam knows the fake device, and Gaussians are drawn by the stand-in."""
    optimizers = sys.modules[torch.optim.Optimizer.__module__]
    name = "_get_fused_kernels_supported_devices"
    monkeypatch.setattr(optimizers, name, lambda: ["cpu", "cuda", "meta"])
    monkeypatch.setattr("wildghand.model.frames.rasterize", stand_in)


@pytest.mark.parametrize("name", VARIANTS)
def test_a_step_reads_nothing_from_the_device(
    name: str, fake_device: None, make_training: TrainingMaker
) -> None:
    fit = fake_fit(make_training("both" if "two hands" in name else "right"), VARIANTS[name])
    order = batches(len(fit.data.frames), fit.batch, 0)
    fit.step(next(order), 0.0)  # tables of targets are made in the first step
    watchers = Watchers()
    with Waits() as waits, HandedOver() as handed:
        for step in range(3):
            loss = fit.step(next(order), 0.5)
            assert watchers.watch(step, loss, fit.model)
            fit.avatar(step)
    assert waits.found == []
    assert handed.found == []


def test_the_mode_sees_what_waits() -> None:
    table, rows = torch.zeros(5, 2, device=FAKE), torch.tensor([1, 2])
    with Waits() as waits:
        rows.to(FAKE, non_blocking=True)
        table * 2.0
        table + torch.tensor(1.0)
        assert waits.found == []
        rows.to(FAKE)
        table[rows]
        with pytest.raises((RuntimeError, NotImplementedError)):
            bool(table.any())
        with pytest.raises((RuntimeError, NotImplementedError)):
            table.nonzero()
    assert waits.found == ["aten._to_copy.default", "aten.index.Tensor"]
    with HandedOver() as handed:
        torch.as_tensor(table)
        torch.tensor([1.0, 2.0])
        table[1:, None]
        assert handed.found == []
        table.new_tensor([1.0])
        torch.as_tensor(np.zeros(2), device=FAKE)
        table[:, [1, 0]]
    assert handed.found == ["new_tensor", "as_tensor", "__getitem__"]


@pytest.mark.skipif(not HAS_GPU, reason="needs a GPU and gsplat")
@pytest.mark.parametrize("name", VARIANTS)
def test_on_a_gpu_only_the_rasterizer_waits(
    name: str, monkeypatch: pytest.MonkeyPatch, make_training: TrainingMaker
) -> None:
    """gsplat itself reads how many tiles its splats cover; for that call the mode is off."""
    import wildghand.model.frames as module

    rasterize = module.rasterize

    def may_wait(*args: Any, **options: Any) -> Any:
        torch.cuda.set_sync_debug_mode("default")
        try:
            return rasterize(*args, **options)
        finally:
            torch.cuda.set_sync_debug_mode("error")

    settings = read_settings({**QUICK, "device": "cuda", **VARIANTS[name]})
    training = make_training("both" if "two hands" in name else "right")
    fit = make_fit(training, settings, 0, ready_device("cuda"))
    order = batches(len(fit.data.frames), fit.batch, 0)
    for _ in range(3):
        fit.step(next(order), 0.0)
    monkeypatch.setattr(module, "rasterize", may_wait)
    torch.cuda.set_sync_debug_mode("error")
    try:
        losses = [fit.step(next(order), 0.5) for _ in range(3)]
    finally:
        torch.cuda.set_sync_debug_mode("default")
    assert all(torch.as_tensor(loss).isfinite() for loss in losses)
