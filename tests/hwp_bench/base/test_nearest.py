"""k-d trees against distances between all pairs, and where SciPy's build would not end."""

from __future__ import annotations

import sys

import numpy as np

from benchmarks.patience import run
from hwp_bench.base.numerics import flushed, flushes, kd_tree

# In a process of its own: a build that does not end kills it.
FLAT = """
import numpy as np
from hwp_bench.base.numerics import flushed
from hwp_bench.base.numerics import kd_tree
points = np.zeros((45, 3))
points[40:] = np.random.default_rng(0).random((5, 3))
with flushed():
    print(kd_tree(points).query([0.0, 0.0, 0.0])[0])
"""


def test_nearest_points_are_those_of_all_pairs() -> None:
    random = np.random.default_rng(1)
    points, places = random.normal(size=(80, 3)), random.normal(size=(20, 3))
    with flushed():
        distance, near = kd_tree(points).query(places)
        assert flushes(), "the switch is as it was before"
    pairs = np.linalg.norm(points[None] - places[:, None], axis=2)
    np.testing.assert_array_equal(near, pairs.argmin(axis=1))
    np.testing.assert_allclose(distance, pairs.min(axis=1), rtol=1e-12)


def test_many_points_at_zero_end_a_build_that_flushes_denormals() -> None:
    # A build that does not end works for ever: ten times what imports and build need.
    done = run([sys.executable, "-c", FLAT], most=60.0)
    assert (done.returncode, done.stdout.strip()) == (0, "0.0"), done.stderr
