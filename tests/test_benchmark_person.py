"""The comparison of a bent hand with the person's. Oracle: people whose hand is known by hand."""

from __future__ import annotations

from typing import Any, cast

import numpy as np

from benchmarks.person import WAYS, Person, drawn, table
from hwp_bench.hands import load_template
from wildghand.subject import SubjectShape

TEMPLATE = load_template("anny", "right")
OFFSET = np.array([0.0, 0.004, 0.003])


def person() -> Person:
    """Someone whose whole hand lies 5 mm off the hand model's."""
    truth = SubjectShape(
        np.tile(OFFSET, (len(TEMPLATE.vertices), 1)), np.tile(OFFSET, (len(TEMPLATE.joints), 1))
    )
    return Person("someone", cast(Any, None), TEMPLATE, truth)


def test_distances_are_lengths() -> None:
    none = SubjectShape(np.zeros_like(TEMPLATE.vertices), np.zeros_like(TEMPLATE.joints))
    for part in person().distances(none):
        np.testing.assert_allclose(part, 0.005)
    for part in person().distances(person().truth):
        np.testing.assert_allclose(part, 0.0)


def test_hands_are_drawn_in_the_colour_of_their_distance() -> None:
    none = SubjectShape(np.zeros_like(TEMPLATE.vertices), np.zeros_like(TEMPLATE.joints))
    far, near = drawn(person(), none), drawn(person(), person().truth)
    hand = (near != 250).any(axis=2)
    assert 0.1 < hand.mean() < 0.5
    # One colour each: the coldest of the scale, and one of its middle.
    assert len(np.unique(near[hand], axis=0)) == 1
    assert len(np.unique(far[(far != 250).any(axis=2)], axis=0)) <= 2
    assert (near[hand][0] != far[hand][0]).any()


def test_the_last_row_is_the_mean() -> None:
    numbers = [np.full((1 + len(WAYS), 2), value) for value in (1.0, 3.0)]
    found = table([("one", numbers[0], 2.0), ("two", numbers[1], 4.0)])
    assert len(found.columns) == len(found.rows[0])
    assert found.rows[-1] == ("mean", *[2.0] * (2 + 2 * len(WAYS)), 3.0)
