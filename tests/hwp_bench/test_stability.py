"""The registry of hard cases and `hwp-bench stability`: discovery, failures, exit status."""

from __future__ import annotations

import json
import sys
import types

import pytest

from hwp_bench.base.errors import HwpError, MissingDependency, UsageError
from hwp_bench.cli.main import main
from hwp_bench.stability import Case, Context, Measured, find_cases, run_cases


def fine(context: Context) -> Measured:
    return Measured(True, f"ran on {context.backend or 'nothing'}")


def wrong(context: Context) -> Measured:
    return Measured(False, "error 3")


def broken(context: Context) -> Measured:
    raise ZeroDivisionError("division by zero")


def cases() -> list[Case]:
    return [
        Case("good", "alpha", "holds", fine, ("cpu", "gpu")),
        Case("bad", "beta", "holds", wrong),
        Case("throws", "beta", "holds", broken),
    ]


@pytest.fixture(autouse=True)
def _provider(monkeypatch: pytest.MonkeyPatch) -> None:
    """A package that offers the cases above, and no other."""
    module = types.ModuleType("offered")
    module.cases = cases
    monkeypatch.setitem(sys.modules, "offered", module)
    point = types.SimpleNamespace(name="offered", value="offered:cases")
    monkeypatch.setattr("hwp_bench.stability.metadata.entry_points", lambda group: [point])


def test_cases_of_installed_packages_are_found() -> None:
    assert [case.name for case in find_cases()] == ["good", "bad", "throws"]
    assert [case.name for case in find_cases(["beta"])] == ["bad", "throws"]
    assert len(find_cases(providers=["offered:cases"])) == 3


def test_what_cannot_be_found_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    with pytest.raises(UsageError, match="Did you mean 'alpha'"):
        find_cases(["alhpa"])
    for source in ("no_such_module:cases", "offered:nothing", "offered"):
        with pytest.raises(HwpError, match=source):
            find_cases(providers=[source])
    monkeypatch.setattr("hwp_bench.stability.metadata.entry_points", lambda group: [])
    with pytest.raises(MissingDependency, match="pip install"):
        find_cases()


def test_a_case_runs_on_each_backend_and_its_exception_is_a_failure() -> None:
    outcomes = list(run_cases(cases()))
    assert [(o.case.name, o.backend, o.measured.passed) for o in outcomes] == [
        ("good", "cpu", True), ("good", "gpu", True), ("bad", "", False), ("throws", "", False),
    ]  # fmt: skip
    assert outcomes[-1].measured.text == "raised ZeroDivisionError: division by zero"
    assert [o.backend for o in run_cases(cases(), ["gpu"])] == ["gpu"]


def test_command_prints_a_table_and_tells_by_its_exit_status(
    capsys: pytest.CaptureFixture[str],
) -> None:
    assert main(["dev", "stability", "--group", "alpha"]) == 0
    out = capsys.readouterr().out
    assert "ran on cpu" in out
    assert "2 of 2 passed" in out
    assert main(["dev", "stability"]) == 1
    captured = capsys.readouterr()
    assert "2 of 4 passed" in captured.out
    assert "failed: bad: error 3" in captured.err


def test_command_prints_json(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["dev", "stability", "--json", "--backend", "cpu"]) == 0
    (row,) = json.loads(capsys.readouterr().out)
    assert row.pop("seconds") >= 0
    assert row == {
        "group": "alpha", "case": "good", "backend": "cpu", "must_hold": "holds",
        "measured": "ran on cpu", "passed": True,
    }  # fmt: skip


def test_command_refuses_what_is_not_there(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["dev", "stability", "--backend", "tpu"]) == 2
    assert "This machine has cpu, gpu" in capsys.readouterr().err
    assert main(["dev", "stability", "--group", "gamma"]) == 2
