"""A second device without a GPU: tensors whose numbers are on the CPU and that say otherwise.

They call themselves tensors of torch's device `meta`, which is there on every machine. As on CUDA,
an operation refuses tensors of two devices, numpy refuses them, and only copies bring them back.
"""

from __future__ import annotations

import contextlib
import dataclasses
import sys
from collections.abc import Iterator
from typing import Any

import pytest
import torch
from torch.overrides import TorchFunctionMode
from torch.utils._python_dispatch import TorchDispatchMode
from torch.utils._pytree import tree_leaves, tree_map

from wildghand.gaussians import losses
from wildghand.splat import api
from wildghand.splat.numba_backend import rasterize_numba
from wildghand.splat.scene import FlatScene

OTHER = torch.device("meta")
# Operations that take indices of the CPU on a tensor of any device.
_INDEXED = ("aten.index.Tensor", "aten.index_put.default", "aten.index_put_.default")
_COPIES = ("aten.copy_.default", "aten._to_copy.default")


class OtherTensor(torch.Tensor):
    """A tensor of the other device, by one of the CPU that holds its numbers."""

    held: torch.Tensor
    __torch_function__: Any = torch._C._disabled_torch_function_impl

    @staticmethod
    def __new__(cls, held: torch.Tensor) -> OtherTensor:
        shape: dict[str, Any] = {
            "strides": held.stride(),
            "storage_offset": held.storage_offset(),
        }
        kind: dict[str, Any] = {"dtype": held.dtype, "device": OTHER}
        return torch.Tensor._make_wrapper_subclass(cls, held.shape, **shape, **kind)

    def __init__(self, held: torch.Tensor) -> None:
        self.held = held

    @classmethod
    def __torch_dispatch__(  # type: ignore[override]
        cls, func: Any, types: Any, args: Any = (), kwargs: Any = None
    ) -> Any:
        return _operate(func, args, kwargs or {})


def _operate(func: Any, args: Any, kwargs: dict[str, Any]) -> Any:
    """An operation on the numbers; its result is where torch would have it."""
    tensors = [leaf for leaf in tree_leaves((args, kwargs)) if isinstance(leaf, torch.Tensor)]
    others = [tensor for tensor in tensors if isinstance(tensor, OtherTensor)]
    # Torch takes a scalar of the CPU anywhere.
    here = [t for t in tensors if t.dim() and not isinstance(t, OtherTensor)]
    name = str(func)
    indexed = name in _INDEXED and isinstance(args[0], OtherTensor)
    if (others and here and name not in _COPIES and not indexed) or any(t.is_meta for t in here):
        raise RuntimeError(f"{name}: tensors of two devices")
    device = kwargs.get("device")
    goes = bool(others) if device is None else torch.device(device) == OTHER
    if device is not None:
        kwargs = {**kwargs, "device": torch.device("cpu")}
    numbers = tree_map(lambda x: x.held if isinstance(x, OtherTensor) else x, (args, kwargs))
    result = func(*numbers[0], **numbers[1])
    if not func._schema.returns:
        return None
    if func._schema.is_mutable:
        return args[0]
    return tree_map(lambda x: OtherTensor(x) if goes and torch.is_tensor(x) else x, result)


class _Operations(TorchDispatchMode):
    """Also those that make a tensor of none."""

    def __torch_dispatch__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        return _operate(func, args, kwargs or {})


class _Numbers(TorchFunctionMode):
    """Numbers of Python that become a tensor of the other device: `meta` would drop them."""

    def __torch_function__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        kwargs, name = dict(kwargs or {}), getattr(func, "__name__", "")
        if name == "new_tensor" and isinstance(args[0], OtherTensor):
            return torch.tensor(args[1], dtype=args[0].dtype).to(OTHER)
        if name in ("tensor", "as_tensor", "sparse_csr_tensor") and kwargs.get("device") == OTHER:
            del kwargs["device"]
            made = func(*args, **kwargs)
            return (made.to_dense() if made.is_sparse_csr else made).to(OTHER)
        if name == "__getitem__" and isinstance(args[0], OtherTensor):
            places = args[1] if isinstance(args[1], tuple) else (args[1],)
            lists = (torch.tensor(p) if isinstance(p, list | tuple) else p for p in places)
            args = (args[0], tuple(lists))
        return func(*args, **kwargs)


def _draw(scene: FlatScene) -> Any:
    """Gaussians of the other device, drawn on the CPU."""
    tensors: dict[str, Any] = {
        name: value.cpu() for name, value in vars(scene).items() if torch.is_tensor(value)
    }
    drawn = rasterize_numba(dataclasses.replace(scene, **tensors))
    return tree_map(lambda x: x.to(OTHER) if torch.is_tensor(x) else x, drawn)


@contextlib.contextmanager
def other_device(monkeypatch: pytest.MonkeyPatch) -> Iterator[torch.device]:
    """Within this there is the other device; the rasterizer and torch's fused Adam know it."""
    name = "_get_fused_kernels_supported_devices"
    optimizers = sys.modules[torch.optim.Optimizer.__module__]
    monkeypatch.setattr(optimizers, name, lambda: ["cpu", "cuda", "meta"])
    monkeypatch.setattr(api, "_backend", lambda chosen, device: ("stand-in", _draw))
    # A tensor that is kept for its device would be found by tests of torch's own `meta`.
    monkeypatch.setattr(losses, "_window_on", losses._window_on.__wrapped__)
    with _Numbers(), _Operations():
        yield OTHER
