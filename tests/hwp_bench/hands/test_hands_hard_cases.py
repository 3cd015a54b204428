"""The hard cases of posing and projection hold. Oracles and tolerances: the line of each case."""

from __future__ import annotations

import pytest

from hwp_bench.hands.hard_cases import cases
from hwp_bench.stability import Case, Context, find_cases


@pytest.mark.parametrize("case", cases(), ids=lambda case: case.name)
def test_hard_case_holds(case: Case) -> None:
    measured = case.run(Context())
    assert measured.passed, f"{case.must_hold}: {measured.text}"


def test_names_are_unique_and_the_registry_finds_them() -> None:
    names = [case.name for case in cases()]
    assert len(names) == len(set(names))
    found = find_cases(["hands"], ["hwp_bench.hands.hard_cases:cases"])
    assert [case.name for case in found] == names
