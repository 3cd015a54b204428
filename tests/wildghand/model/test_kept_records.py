"""Records that a model keeps, in files. Oracles: what was written, and damage of every kind."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor

from hwp_bench.base.errors import BadInput
from wildghand.gaussians.found import Found
from wildghand.light import CastLight, KnownLight
from wildghand.model.model import FOUND
from wildghand.poses import ClipPoses
from wildghand.subject import SubjectShape
from wildghand.visibility import ColorChanges, Visibility

COUNTS = {"N": {"left": 4, "right": 5}}
#: What is read with it, and an example.
EXAMPLES: dict[type[Found], tuple[dict[str, Any], Found]] = {
    KnownLight: (
        {},
        KnownLight(
            torch.eye(3), torch.ones(3), torch.tensor(0.3), torch.eye(3)[2], torch.tensor(0.5)
        ),
    ),
    CastLight: ({}, CastLight(np.eye(3, dtype=np.float32), np.ones(3, np.float32), 0.25)),
    ClipPoses: (
        {},
        ClipPoses(
            {"right": np.ones((4, 51), np.float32)}, {"right": np.zeros((4, 51), np.float32)}
        ),
    ),
    Visibility: (
        COUNTS,
        Visibility(
            {side: torch.linspace(0.0, 1.0, n) for side, n in COUNTS["N"].items()},
            {side: torch.full((n,), 0.25) for side, n in COUNTS["N"].items()},
            frozenset({"left"}),
        ),
    ),
    ColorChanges: (
        COUNTS,
        ColorChanges({side: torch.full((n, 3), -2.0) for side, n in COUNTS["N"].items()}),
    ),
    SubjectShape: ({"V": 7}, SubjectShape(np.full((7, 3), 0.015625), np.full((16, 3), -0.03125))),
}
DAMAGE: dict[str, Callable[[Tensor], Tensor | None]] = {
    "missing": lambda tensor: None,
    "of another shape": lambda tensor: tensor[..., None],
    "no number": lambda tensor: torch.full_like(tensor, torch.nan),
    "too large": lambda tensor: tensor + 1e9,
    "too small": lambda tensor: tensor - torch.inf,
}
KINDS = pytest.mark.parametrize("kind", EXAMPLES, ids=lambda kind: kind.__name__)


def test_every_kind_that_a_model_keeps_has_an_example() -> None:
    assert {kind for kind, *_ in FOUND} <= set(EXAMPLES)


@KINDS
def test_it_is_read_as_it_was_written(kind: type[Found]) -> None:
    sizes, example = EXAMPLES[kind]
    tensors = example.to_tensors()
    assert all(name.startswith(kind.prefix) for name in tensors)
    read = kind.from_tensors({**tensors, "other": torch.zeros(1)}, "an avatar", **sizes)
    assert read is not None
    assert read.equals(example)
    assert kind.from_tensors({}, "an avatar", **sizes) is None


@KINDS
@pytest.mark.parametrize("damage", DAMAGE)
def test_damage_is_refused_by_name(kind: type[Found], damage: str) -> None:
    sizes, example = EXAMPLES[kind]
    tensors = example.to_tensors()
    for name, tensor in tensors.items():
        spoilt = {**tensors, name: DAMAGE[damage](tensor)}
        kept = {each: value for each, value in spoilt.items() if value is not None}
        with pytest.raises(BadInput, match=name):
            kind.from_tensors(kept, "an avatar", **sizes)


@pytest.mark.parametrize(
    ("kind", "name"), [(KnownLight, "light_strengths"), (ClipPoses, "poses_believed_right")]
)
def test_lengths_that_do_not_agree_are_refused(kind: type[Found], name: str) -> None:
    tensors = EXAMPLES[kind][1].to_tensors()
    tensors[name] = tensors[name][:-1]
    with pytest.raises(BadInput, match=name):
        kind.from_tensors(tensors, "an avatar")
