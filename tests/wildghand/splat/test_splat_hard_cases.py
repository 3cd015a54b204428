"""The catalogue of `hwp-bench stability`; oracles: the float64 reference, and the same scene
without the bad Gaussian. Tolerances: those of `wildghand.splat.hard_cases`.
"""

from __future__ import annotations

import pytest

from hwp_bench.stability import Case, Context
from wildghand.splat.hard_cases import cases

CASES = [(case, backend) for case in cases() for backend in case.backends]


@pytest.mark.parametrize(
    ("case", "backend"), CASES, ids=[f"{backend}-{case.name}" for case, backend in CASES]
)
def test_hard_case_holds(case: Case, backend: str) -> None:
    measured = case.run(Context(backend))
    assert measured.passed, f"{case.must_hold}: {measured.text}"
