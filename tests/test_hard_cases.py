"""The hard cases of every group but the splats hold, and can fail.

Oracles and tolerances: the line of each case.
"""

from __future__ import annotations

import math
from dataclasses import replace
from importlib import import_module
from typing import Any

import numpy as np
import pytest
import torch

from hwp_bench.hands.skinning import PosedHand, pose_hand
from hwp_bench.stability import Case, CaseGroup, Context, find_cases, largest

PROVIDERS = {
    "hands": "hwp_bench.hands.hard_cases",
    "method": "wildghand.fitting.hard_cases",
    "metrics": "hwp_bench.metrics.hard_cases",
    "optimizer": "wildghand.gaussians.hard_cases",
    "prepass": "wildghand.prepass.hard_cases",
    "shadows": "wildghand.light.hard_cases",
}


def group(name: str) -> CaseGroup:
    return import_module(PROVIDERS[name]).cases


def failed(name: str) -> set[str]:
    """The cases of a group that do not hold, an exception included."""
    found = set()
    for case in group(name)():
        try:
            passed = case.run(Context()).passed
        except Exception:
            passed = False
        if not passed:
            found.add(case.name)
    return found


@pytest.mark.parametrize(
    "case",
    [case for name in PROVIDERS for case in group(name)()],
    ids=lambda case: f"{case.group}: {case.name}",
)
def test_hard_case_holds(case: Case) -> None:
    measured = case.run(Context())
    assert measured.passed, f"{case.must_hold}: {measured.text}"


@pytest.mark.parametrize("name", PROVIDERS)
def test_names_are_unique_and_the_registry_finds_them(name: str) -> None:
    names = [case.name for case in group(name)()]
    assert len(names) == len(set(names))
    found = find_cases([name], [f"{PROVIDERS[name]}:cases"])
    assert [case.name for case in found] == names


def test_cases_notice_what_is_wrong(monkeypatch: pytest.MonkeyPatch) -> None:
    with monkeypatch.context() as spoilt:
        spoilt.setattr("hwp_bench.metrics.score.decibels", lambda mse, cap=0.0: 30.0)
        assert "noise on a mask of a disc" in failed("metrics")
    with monkeypatch.context() as spoilt:
        # What Adam did before gradients were looked at.
        spoilt.setattr("wildghand.gaussians.adam.LARGEST", math.inf)
        assert {"one gradient of 1e+30, clipped at 0"} <= failed("optimizer")
    with monkeypatch.context() as spoilt:
        spoilt.setattr(torch, "_fused_adam_", lambda *given, **more: None)
        assert "gradients of 1, clipped at 0.5" in failed("optimizer")
    with monkeypatch.context() as spoilt:
        spoilt.setattr("wildghand.prepass.judge.LEAST_FRAMES", 1)
        assert "2 frames" in failed("prepass")
    with monkeypatch.context() as spoilt:
        blocked = "hwp_bench.base.rays.EmbreeMesh.blocked"
        spoilt.setattr(blocked, lambda self, starts, ways: np.zeros(len(starts), dtype=bool))
        assert "light 30 degrees from straight above a plate" in failed("shadows")


def test_nan_in_the_second_place_fails(monkeypatch: pytest.MonkeyPatch) -> None:
    assert math.isnan(largest([1.0, math.nan]))
    assert math.isnan(largest([math.nan, 1.0]))
    assert largest(iter([1.0, 3.0, 2.0])) == 3.0

    def with_bad_landmarks(*arguments: Any) -> PosedHand:
        posed = pose_hand(*arguments)
        return replace(posed, landmarks=posed.landmarks * math.nan)

    # Vertices are compared first, and are right.
    monkeypatch.setattr("hwp_bench.hands.hard_cases.pose_hand", with_bad_landmarks)
    assert {"a template in float16", "every beta at +20"} <= failed("hands")
