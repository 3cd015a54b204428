"""Changes of colours in an avatar's file. Oracle: the tensors that were written."""

from __future__ import annotations

import pytest
import torch

from hwp_bench.base.errors import BadInput
from wildghand.evidence import ColorChanges, rename_former
from wildghand.gaussians.attributes import CHANNELS, RawAttributes

COUNTS = {"left": 40, "right": 40}


def some_changes() -> ColorChanges:
    generator = torch.Generator().manual_seed(0)
    return ColorChanges({side: torch.randn(40, 3, generator=generator) for side in COUNTS})


def test_colours_alone_change() -> None:
    made = some_changes()
    raw = RawAttributes.split(torch.zeros(2, 40, CHANNELS))
    changed = made.color("left", raw)
    for name, values in changed.items():
        expected = made.changes["left"] if name == "logit_colors" else torch.zeros(())
        torch.testing.assert_close(values, expected.expand_as(values))


@pytest.mark.parametrize("former", [False, True])
def test_they_are_read_as_they_were_written(former: bool) -> None:
    made = some_changes()
    tensors = made.to_tensors()
    if former:
        tensors = {
            name.replace("color_changes_", "other_hand_"): value for name, value in tensors.items()
        }
        assert ColorChanges.from_tensors(tensors, "an avatar", N=COUNTS) is None
    read = ColorChanges.from_tensors(rename_former(tensors), "an avatar", N=COUNTS)
    assert read is not None
    for side, change in made.changes.items():
        assert torch.equal(read.changes[side], change)


@pytest.mark.parametrize(
    "value",
    [torch.zeros(40, 2), torch.full((40, 3), 100.0), torch.full((40, 3), float("nan")), None],
    ids=str,
)
def test_hostile_changes_are_refused_by_name(value: torch.Tensor | None) -> None:
    tensors = some_changes().to_tensors()
    if value is None:
        del tensors["color_changes_left"]
    else:
        tensors["color_changes_left"] = value
    with pytest.raises(BadInput, match="color_changes_left"):
        ColorChanges.from_tensors(tensors, "an avatar", N=COUNTS)
    assert ColorChanges.from_tensors({}, "an avatar", N=COUNTS) is None
