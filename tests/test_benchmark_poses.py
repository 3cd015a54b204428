"""Poses compared with true ones. Oracle: a shift whose size in the image is known by hand."""

from __future__ import annotations

from dataclasses import replace
from typing import Any, cast

import numpy as np
import pytest
from small_captures import cameras, hand_parameters

from benchmarks.poses import COLORS, Poses, drawn, row, table
from hwp_bench.hands import load_template

FRAMES, SIZE = 20, 64
TEMPLATE = load_template("anny", "right")


class _Capture:
    """A capture of one hand, as far as poses are compared."""

    class info:
        id = "someone"

    cameras = cameras(FRAMES, SIZE)

    def __len__(self) -> int:
        return FRAMES

    def template(self, side: str) -> object:
        return TEMPLATE

    def clean(self, frame: int) -> np.ndarray:
        return np.zeros((SIZE, SIZE, 3), dtype=np.uint8)


def poses() -> Poses:
    """Hands that are given 1 cm too far to the right, and believed where they are."""
    true = replace(hand_parameters(FRAMES), pose=np.zeros((FRAMES, 16, 3)))
    given = replace(true, transl=true.transl + np.array([0.01, 0.0, 0.0]))
    capture = cast(Any, _Capture())
    return Poses(capture, {"right": given}, {"right": true}, {"right": true}, 0.5)


def test_a_shift_is_its_length_in_the_image() -> None:
    name, errors = row(poses(), "right")
    assert name == "someone, right"
    # The hand at rest is up to 10 cm nearer or farther than half a metre.
    shift = 0.01 / 0.5 * 0.9 * SIZE
    assert errors[0] == pytest.approx(shift, rel=0.2)
    assert errors[2] == pytest.approx(errors[0], rel=0.01)
    assert errors[1] == errors[3] == 0.0
    assert errors[4:] == [0.0, 0.0, 0.5]


def test_the_last_row_is_the_mean() -> None:
    found = table([poses(), poses()])
    assert found.rows[-1] == ("mean", *found.rows[0][1:])
    assert len(found.columns) == len(found.rows[0])


def test_believed_hands_are_drawn_over_true_ones() -> None:
    tiles = drawn(poses())
    assert len(tiles) == 6
    colors = {tuple(color) for tile in tiles for color in tile.reshape(-1, 3)}
    assert COLORS["given"] in colors
    assert COLORS["believed"] in colors
