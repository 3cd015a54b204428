"""Holm and tie groups. Oracles: Holm's worked rule by hand, the definition of the letters."""

from __future__ import annotations

from itertools import combinations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from hwp_bench.analysis.statistics.compare import holm, tie_groups


def test_holm_by_hand() -> None:
    assert holm([0.01, 0.04, 0.03, 0.005]) == pytest.approx([0.03, 0.06, 0.06, 0.02])
    assert holm([0.9, 0.8]) == [1.0, 1.0]
    assert holm([]) == []


@given(st.lists(st.floats(0, 1), min_size=1, max_size=8))
def test_holm_lies_between_plain_and_bonferroni(values: list[float]) -> None:
    for value, adjusted in zip(values, holm(values), strict=True):
        assert value <= adjusted <= min(1, value * len(values)) + 1e-12


def test_letters_of_a_chain() -> None:
    apart = {(0, 1): False, (1, 2): False, (0, 2): True}
    assert tie_groups(3, apart) == ["a", "ab", "b"]
    assert tie_groups(3, dict.fromkeys(combinations(range(3), 2), True)) == ["a", "b", "c"]
    assert tie_groups(3, {}) == ["a", "a", "a"]


@given(
    st.integers(2, 7).flatmap(
        lambda n: st.tuples(st.just(n), st.sets(st.sampled_from(list(combinations(range(n), 2)))))
    )
)
def test_two_items_share_a_letter_exactly_where_they_are_not_told_apart(case) -> None:
    count, different = case
    pairs = list(combinations(range(count), 2))
    letters = tie_groups(count, {pair: pair in different for pair in pairs})
    assert all(letters)
    for first, second in pairs:
        shared = bool(set(letters[first]) & set(letters[second]))
        assert shared == ((first, second) not in different)
