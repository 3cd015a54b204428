"""The catalogue of `hwp-bench stability`; oracles: the float64 reference, and the same scene
without the bad Gaussian. Tolerances: those of `wildghand.splat.hard_cases`.
"""

from __future__ import annotations

import math
from typing import Any

import pytest

from hwp_bench.stability import Case, Context
from wildghand.splat.hard_cases import DrawnScene, cases, draw

CASES = [(case, backend) for case in cases() for backend in case.backends]


@pytest.mark.parametrize(
    ("case", "backend"), CASES, ids=[f"{backend}-{case.name}" for case, backend in CASES]
)
def test_hard_case_holds(case: Case, backend: str) -> None:
    measured = case.run(Context(backend))
    assert measured.passed, f"{case.must_hold}: {measured.text}"


def test_a_nan_beside_right_numbers_fails(monkeypatch: pytest.MonkeyPatch) -> None:
    def with_bad_colors(*arguments: Any) -> DrawnScene:
        drawing = draw(*arguments)
        drawing.gradients["colors"].fill_(math.nan)
        return drawing

    monkeypatch.setattr("wildghand.splat.hard_cases.draw", with_bad_colors)
    run = {case.name: case.run for case in cases()}["a hand"]
    measured = run(Context("numba"))
    assert not measured.passed
    assert "(colors)" in measured.text
