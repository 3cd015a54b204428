"""Some of many things, spread evenly."""

from __future__ import annotations

import numpy as np


def evenly(count: int, most: int) -> np.ndarray:
    """Choose among things in a row, from the first to the last.

    Args:
        count: how many there are, not negative.
        most: how many are chosen at most, not negative; with 1 it is the first.

    Returns:
        (K,) int64, their numbers, ascending and all different; all of them where `count` is not
        larger than `most`.
    """
    return np.unique(np.linspace(0, count - 1, min(count, most)).round().astype(np.int64))
