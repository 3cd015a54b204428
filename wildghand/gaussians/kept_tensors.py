"""Tensors that an avatar keeps next to its network, checked before they are used."""

from __future__ import annotations

from collections.abc import Mapping

from torch import Tensor

from hwp_bench.base.errors import BadInput


def kept_tensor(
    tensors: Mapping[str, Tensor],
    name: str,
    shape: tuple[int, ...],
    bounds: tuple[float, float],
    where: str,
) -> Tensor:
    """One of the tensors of an avatar.

    Args:
        tensors: of the avatar.
        name: which of them.
        shape: that it must have.
        bounds: least and largest number in it.
        where: the file, for messages.

    Raises:
        BadInput: it is missing, of another shape, or holds another number, or none.
    """
    tensor, (low, high) = tensors.get(name), bounds
    if tensor is None or tuple(tensor.shape) != shape:
        raise BadInput(f"has not the shape {shape}", where=where, field=name)
    if not bool(((tensor >= low) & (tensor <= high)).all()):
        raise BadInput(f"lies outside {low} to {high}", where=where, field=name)
    return tensor
