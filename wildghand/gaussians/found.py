"""What a fit finds next to its network: records of tensors, which an avatar keeps by name.

A record declares how each of its fields stands in a file:

    @dataclass(frozen=True, eq=False)
    class Lamp(Found):
        prefix = "lamp_"
        longest: ClassVar = {"K": 64}
        #: (K, 3) unit vectors.
        directions: Annotated[Tensor, Kept(("K", 3), -1.0, 1.0)]
        #: (N,) by side.
        shares: Annotated[Mapping[str, Tensor], Kept(("N",), 0.0, 1.0)]

writes `lamp_directions`, `lamp_shares_right` and `lamp_shares_left`, and reads nothing else.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from types import MappingProxyType
from typing import Annotated, Any, ClassVar, NamedTuple, Self, get_args, get_origin, get_type_hints

import numpy as np
import torch
from torch import Tensor

from hwp_bench.base.errors import BadInput

#: Sides that are looked for where none are given.
SIDES = ("right", "left")
_REMEDY = "It is damaged: take another copy, or fit it again."


@dataclass(frozen=True)
class Kept:
    """How a field of a `Found` stands in a file, where all numbers are float32."""

    #: Lengths of the axes: a number, or a letter that stands for the same length everywhere.
    shape: tuple[int | str, ...]
    #: Smallest and largest number.
    least: float
    most: float
    #: What follows the prefix in the tensor's name; None: the field's own name.
    name: str | None = None
    #: Of an array in memory.
    dtype: type[np.floating[Any]] = np.float32


class _Field(NamedTuple):
    """A declared field: a tensor, an array or a number, or one of these for each hand."""

    field: str
    kept: Kept
    kind: type
    by_side: bool
    prefix: str

    def name(self, side: str) -> str:
        """The name of its tensor; of one that both hands share, `side` is empty."""
        own = self.field if self.kept.name is None else self.kept.name
        return self.prefix + "_".join(part for part in (own, side) if part)

    def in_memory(self, tensor: Tensor) -> Any:
        """The field's value."""
        if self.kind is Tensor:
            return tensor.float()
        values = tensor.detach().cpu().numpy().astype(self.kept.dtype)
        return float(values) if self.kind is float else values


@dataclass(frozen=True, eq=False)
class Found:
    """Tensors that were found next to the network; fields without `Kept` are not written."""

    #: How the names of its tensors begin.
    prefix: ClassVar[str]
    #: Largest lengths that are read, of letters that are free.
    longest: ClassVar[Mapping[str, int]] = MappingProxyType({})

    def to_tensors(self) -> dict[str, Tensor]:
        """The fields as float32 tensors, by the names under which an avatar keeps them."""
        tensors = {}
        for item in _declared(type(self)):
            value = getattr(self, item.field)
            for side, part in (value if item.by_side else {"": value}).items():
                tensors[item.name(side)] = torch.as_tensor(part, dtype=torch.float32)
        return tensors

    @classmethod
    def from_tensors(
        cls, tensors: Mapping[str, Tensor], where: str, **sizes: int | Mapping[str, int]
    ) -> Self | None:
        """Read what `to_tensors` made.

        Args:
            tensors: of an avatar.
            where: the file, for messages.
            sizes: lengths that letters of the shapes stand for, such as `N={"right": 800}`. A
                letter without one is free. Where one is given by side, these sides must be there;
                else each side may be absent.

        Returns:
            The record; None where the avatar keeps none.

        Raises:
            BadInput: a tensor is missing, of another shape, or holds another number, or none.
        """
        given = next((size for size in sizes.values() if isinstance(size, Mapping)), None)
        parts = [
            (item, side)
            for item in _declared(cls)
            for side in ((given or SIDES) if item.by_side else ("",))
        ]
        there = {side for item, side in parts if item.name(side) in tensors}
        if not there:
            return None
        found: dict[str, Any] = {}
        lengths: dict[str, dict[str, int]] = {
            side: {
                letter: size if isinstance(size, int) else size.get(side, 0)
                for letter, size in sizes.items()
            }
            for _, side in parts
        }
        for item, side in parts:
            if side and given is None and side not in there:
                continue
            own = lengths[side]
            shape = tuple(own.get(str(axis), axis) for axis in item.kept.shape)
            bounds = item.kept.least, item.kept.most
            tensor = read_tensor(tensors, item.name(side), shape, bounds, where, cls.longest)
            own |= zip(map(str, item.kept.shape), tensor.shape, strict=True)
            value = item.in_memory(tensor)
            if item.by_side:
                found.setdefault(item.field, {})[side] = value
            else:
                found[item.field] = value
        return cls(**found)

    def to(self, device: torch.device | str) -> Self:
        """The same with its tensors on a device; arrays stay on the CPU."""
        moved: dict[str, Any] = {}
        for item in _declared(type(self)):
            if item.kind is Tensor:
                value = getattr(self, item.field)
                moved[item.field] = (
                    {side: part.to(device) for side, part in value.items()}
                    if item.by_side
                    else value.to(device)
                )
        return replace(self, **moved)

    def equals(self, other: Found | None) -> bool:
        """Whether another would be written as the same tensors."""
        if type(other) is not type(self):
            return False
        mine, theirs = self.to_tensors(), other.to_tensors()
        return mine.keys() == theirs.keys() and all(
            torch.equal(tensor, theirs[name]) for name, tensor in mine.items()
        )


def _declared(cls: type[Found]) -> list[_Field]:
    """The fields that are written."""
    fields = []
    for field, hint in get_type_hints(cls, include_extras=True).items():
        if get_origin(hint) is not Annotated:
            continue
        kind, kept = get_args(hint)
        by_side = get_origin(kind) is Mapping
        kind = get_args(kind)[1] if by_side else kind
        fields.append(_Field(field, kept, kind, by_side, cls.prefix))
    return fields


def read_tensor(
    tensors: Mapping[str, Tensor],
    name: str,
    shape: tuple[int | str, ...],
    bounds: tuple[float, float],
    where: str,
    longest: Mapping[str, int] | None = None,
) -> Tensor:
    """One of the tensors of an avatar.

    Args:
        tensors: of the avatar.
        name: which of them.
        shape: that it must have; a letter stands for any length from 1.
        bounds: least and largest number in it.
        where: the file, for messages.
        longest: largest lengths that letters stand for.

    Raises:
        BadInput: it is missing, of another shape, or holds another number, or none.
    """
    tensor, (low, high) = tensors.get(name), bounds
    if tensor is None:
        raise BadInput("is missing", where=where, field=name, remedy=_REMEDY)
    fits = len(shape) == tensor.ndim and all(
        length == axis if isinstance(axis, int) else 0 < length <= (longest or {}).get(axis, length)
        for axis, length in zip(shape, tensor.shape, strict=True)
    )
    if not fits:
        named = ", ".join(map(str, shape))
        raise BadInput(
            f"has the shape {tuple(tensor.shape)} where ({named}) is expected",
            where=where,
            field=name,
            remedy=_REMEDY,
        )
    if not bool(((tensor >= low) & (tensor <= high)).all()):
        raise BadInput(f"lies outside {low:g} to {high:g}", where=where, field=name, remedy=_REMEDY)
    return tensor
