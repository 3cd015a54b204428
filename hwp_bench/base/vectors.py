"""Products of two vectors (3,), for compiled loops.

The sums are written out: a library's order of summing depends on the processor.
"""

from __future__ import annotations

import numpy as np

from hwp_bench.base.compiled import helper


@helper
def dot(a: np.ndarray, b: np.ndarray) -> float:
    """Scalar product of two vectors (3,)."""
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


@helper
def cross(a: np.ndarray, b: np.ndarray, out: np.ndarray) -> None:
    """Vector product of two vectors (3,), written into `out`, which is neither of them."""
    out[0] = a[1] * b[2] - a[2] * b[1]
    out[1] = a[2] * b[0] - a[0] * b[2]
    out[2] = a[0] * b[1] - a[1] * b[0]
