"""The command of the whole field. Oracle: the folders of the methods that ship."""

from __future__ import annotations

import sys
from pathlib import Path

import pytest

from benchmarks import field

ROOT = Path(__file__).resolve().parents[1]


def test_every_method_is_evaluated_on_every_suite(monkeypatch: pytest.MonkeyPatch) -> None:
    calls: list[list[str]] = []
    monkeypatch.setattr(field, "hwp_bench", lambda words: calls.append(words) or len(calls) - 1)
    words = ["field", "--suites", "mini", "wild-test", "--seeds", "2", "--seconds", "8", "-o", "r"]
    monkeypatch.setattr(sys, "argv", [*words, "--jobs", "2"])
    assert field.main() == 1
    folders = {file.parent.name for file in (ROOT / "baselines").glob("*/method.toml")}
    for words, suite in zip(calls, ("mini", "wild-test"), strict=True):
        end = words.index("--suite")
        assert words[0] == "evaluate"
        assert set(words[1:end]) == {*folders, "wildghand"}
        limits = ["--seeds", "2", "--budget", "8", "-o", f"r/{suite}", "--jobs", "2"]
        assert words[end:] == ["--suite", suite, *limits]
    # Some methods, with the numbers that are not given.
    monkeypatch.setattr(
        sys, "argv", ["field", "--suites", "persistent", "--methods", "plain", "wild"]
    )
    field.main()
    limits = ["--seeds", "3", "--budget", "64", "-o", "runs/field/persistent"]
    assert calls[-1] == ["evaluate", "plain", "wild", "--suite", "persistent", *limits]
