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


def test_catalogue_covers_what_the_issue_lists() -> None:
    names = " ".join(case.name for case in cases())
    for needed in (
        "all Gaussians at one point",
        "identical depths",
        "alpha saturated",
        "10,000 layers",
        "focal length 1e6",
        "half off screen",
        "3 cm in front",
        "zero Gaussians",
        "image of 1 x 1",
        "needles",
        *(f"{kind} in {argument}" for kind in ("NaN", "+inf", "-inf") for argument in (
            "means", "quats", "scales", "opacities", "colors", "backgrounds", "viewmats", "Ks"
        )),
    ):  # fmt: skip
        assert needed in names
    assert len({case.name for case in cases()}) == len(cases())
