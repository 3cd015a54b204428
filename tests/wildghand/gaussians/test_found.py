"""Records of what a fit finds, in files. Oracles: what was written, and a table of damage."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Annotated, ClassVar

import numpy as np
import pytest
import torch
from torch import Tensor

from hwp_bench.base.errors import BadInput
from wildghand.gaussians.found import Found, Kept


@dataclass(frozen=True, eq=False)
class Lamp(Found):
    """A field of each kind."""

    prefix = "lamp_"
    longest: ClassVar = {"K": 4}
    ways: Annotated[Tensor, Kept(("K", 3), -1.0, 1.0)]
    strengths: Annotated[np.ndarray, Kept(("K",), 0.0, 9.0, dtype=np.float64)]
    ambient: Annotated[float, Kept((), 0.0, 9.0)]
    shares: Annotated[Mapping[str, Tensor], Kept(("N",), 0.0, 1.0, name="of")]
    #: Not written.
    note: str = ""


def a_lamp() -> Lamp:
    shares = {"right": torch.tensor([0.0, 0.5]), "left": torch.tensor([1.0])}
    return Lamp(torch.eye(3), np.array([0.0, 1.0, 2.0]), 0.25, shares, note="mine")


COUNTS = {"right": 2, "left": 1}


def test_it_is_read_as_it_was_written() -> None:
    tensors = a_lamp().to_tensors()
    names = ["lamp_ways", "lamp_strengths", "lamp_ambient", "lamp_of_right", "lamp_of_left"]
    assert list(tensors) == names
    assert {tensor.dtype for tensor in tensors.values()} == {torch.float32}
    read = Lamp.from_tensors({**tensors, "other": torch.zeros(1)}, "file", N=COUNTS)
    assert read is not None
    assert read.equals(a_lamp())
    assert isinstance(read.ambient, float)
    assert read.strengths.dtype == np.float64
    assert read.note == ""
    assert read.to("meta").shares["left"].is_meta
    assert not read.equals(None)


def test_none_is_written_of_a_record_that_is_absent() -> None:
    assert Lamp.from_tensors({"other": torch.zeros(1)}, "file", N=COUNTS) is None


def test_a_side_may_be_absent_where_none_is_asked_for() -> None:
    tensors = a_lamp().to_tensors()
    del tensors["lamp_of_left"]
    read = Lamp.from_tensors(tensors, "file")
    assert read is not None
    assert list(read.shares) == ["right"]
    with pytest.raises(BadInput, match=r"lamp_of_left.* is missing"):
        Lamp.from_tensors(tensors, "file", N=COUNTS)


@pytest.mark.parametrize(
    ("name", "value", "message"),
    [
        ("ways", torch.zeros(3, 2), r"shape \(3, 2\) where \(K, 3\)"),
        ("ways", torch.zeros(0, 3), "shape"),
        ("ways", torch.zeros(5, 3), "shape"),
        ("ways", torch.full((3, 3), 1.1), "lies outside -1 to 1"),
        ("strengths", torch.zeros(2), r"where \(3\)"),
        ("strengths", torch.full((3,), torch.nan), "lies outside"),
        ("ambient", torch.zeros(1), "shape"),
        ("ambient", None, "is missing"),
        ("of_left", torch.zeros(2), "shape"),
    ],
)
def test_damage_is_refused_by_name(name: str, value: Tensor | None, message: str) -> None:
    tensors: dict[str, Tensor | None] = {**a_lamp().to_tensors(), f"lamp_{name}": value}
    there = {each: tensor for each, tensor in tensors.items() if tensor is not None}
    with pytest.raises(BadInput, match=rf"file: lamp_{name}: .*{message}"):
        Lamp.from_tensors(there, "file", N=COUNTS)
