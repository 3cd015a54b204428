"""Nearest neighbours: SciPy's k-d tree, built so that it always ends."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from hwp_bench.base.denormals import set_flush

if TYPE_CHECKING:
    from scipy.spatial import cKDTree


def kd_tree(points: np.ndarray) -> cKDTree:
    """Build a tree over points.

    Where half of the points share their least coordinate, SciPy splits at the next number above
    it. Above 0 that is a denormal number. A thread that flushes these reads it as 0 again, and
    the build calls itself until the process dies. So the thread keeps denormals while it builds;
    queries do not need them.

    Args:
        points: (N, D), finite.

    Returns:
        `scipy.spatial.cKDTree`.
    """
    from scipy.spatial import cKDTree

    before = set_flush(False)
    try:
        return cKDTree(points)
    finally:
        set_flush(before)
