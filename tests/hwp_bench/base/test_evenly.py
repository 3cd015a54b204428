"""Things that are chosen evenly. Oracle: what even means, checked for every gap."""

from __future__ import annotations

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from hwp_bench.base.arrays import evenly


@given(count=st.integers(0, 3000), most=st.integers(0, 500))
def test_both_ends_and_gaps_that_differ_by_one(count: int, most: int) -> None:
    found = evenly(count, most)
    assert len(found) == min(count, most)
    assert found.dtype == np.int64
    if len(found) > 1:
        assert (found[0], found[-1]) == (0, count - 1)
        gaps = np.diff(found)
        # A rounded place is half a step off at most, so two neighbours are one.
        assert gaps.min() >= 1
        assert abs(gaps - (count - 1) / (len(found) - 1)).max() <= 1.0


def test_one_is_the_first_and_few_are_all() -> None:
    assert evenly(7, 1).tolist() == [0]
    assert evenly(4, 9).tolist() == [0, 1, 2, 3]
    assert evenly(9, 3).tolist() == [0, 4, 8]
