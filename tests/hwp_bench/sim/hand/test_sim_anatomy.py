"""Lines on the skin. Oracle: the nearest of many points along the line, by SciPy's KD-tree."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
import pytest
from scipy.spatial import cKDTree

from hwp_bench.sim.hand import anatomy

#: Points along each segment of the oracle.
DENSE = 4000


@pytest.mark.parametrize("points", [2, 5, 24])
def test_a_line_fades_with_the_distance_from_it(points: int) -> None:
    rng = np.random.default_rng(points)
    line = np.cumsum(rng.normal(0.0, 0.06, (points, 2)), axis=0)
    places = rng.uniform(-1.0, 1.0, (3 * anatomy._BLOCK + 17, 2))
    width = 0.05
    found = anatomy._drawn(places, line, width)

    steps = np.linspace(0.0, 1.0, DENSE)[:, None]
    along = np.concatenate([a + steps * (b - a) for a, b in pairwise(line)])
    distance, _ = cKDTree(along).query(places)
    expected = np.exp(-((distance / width) ** 2))
    # Between two of the oracle's points the line is nearer, by less than their distance.
    np.testing.assert_allclose(found, expected, atol=2e-4)
    # What is left out is far away, and so little that a sum with anything else does not see it.
    assert expected[found == 0.0].max() < np.exp(-anatomy._LOST)
    assert (found > 0.5).any()


def test_a_line_without_a_length_is_a_dot() -> None:
    dot = np.full((2, 2), 0.25)
    places = np.array([[0.25, 0.25], [0.25, 0.35], [9.0, 9.0]])
    np.testing.assert_allclose(anatomy._drawn(places, dot, 0.1), [1.0, np.exp(-1.0), 0.0])
