"""The view of all jobs. Oracle: what a person would read of it."""

from __future__ import annotations

import sys

import pytest

from hwp_bench.run.engine.view import JobsView


@pytest.mark.parametrize("terminal", [False, True])
def test_jobs_are_told_of_once_each(terminal: bool, capsys, monkeypatch) -> None:
    monkeypatch.setattr(sys.stderr, "isatty", lambda: terminal)
    with JobsView() as view:
        view.begin(3)
        view.start(0, "one [bold]", "a")
        view.start(1, "two", "b")
        view.steps(0, 3, 4)
        view.steps(2, 1, 4)
        view.start(1, "two", "c")
        view.end(0, "one [bold]")
        view.end(1, "two", "no luck")
        view.end(2, "three")
    captured = capsys.readouterr()
    assert captured.out == ""
    assert captured.err.count("[2/3] again, its worker was lost: two, on c") == 1
    assert captured.err.count("two failed: no luck") == 1
    if terminal:
        assert "3/3" in captured.err
    else:
        assert captured.err.splitlines()[:2] == ["[1/3] one [bold], on a", "[2/3] two, on b"]
        assert "[3 of 3 ended, 0:00:00 elapsed] three" in captured.err
