"""Stages and the time that is left. Oracle: what a person would read of it."""

from __future__ import annotations

import sys

import pytest
from stopped_clock import Clock, stop_clock

from hwp_bench.base.console import OUTER, StagesView, progress


@pytest.fixture
def clock(monkeypatch: pytest.MonkeyPatch) -> Clock:
    return stop_clock(monkeypatch, "hwp_bench.base.console", "hwp_bench.base.console")


def test_off_a_terminal_each_stage_is_a_line(clock: Clock, capsys) -> None:
    with StagesView() as view:
        view.stage(1, 2, "Tracking", own=10.0, later=80.0)
        clock.now += 12.0
        view.stage(2, 2, "Fitting [bold]", own=60.0, later=0.0)
        with progress("steps", 3) as update:
            update(3)
    captured = capsys.readouterr()
    assert captured.out == ""
    assert captured.err.splitlines() == [
        "[1/2] Tracking (0:00 elapsed, about 1:30 left)",
        "[2/2] Fitting [bold] (0:12 elapsed, about 1:00 left)",
        "steps: 3 in 0.0 s",
    ]


def test_on_a_terminal_one_display_shows_stage_and_steps(
    clock: Clock, capsys, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(sys.stderr, "isatty", lambda: True)
    with StagesView() as view:
        view.stage(2, 4, "Fitting [bold]", own=60.0, later=5.0)
        with progress("steps", 8) as update:
            clock.now += 20.0
            update(6)
            assert view._bars is not None
            shown = {task.description: task for task in view._bars.tasks}
            assert shown["  steps"].completed == 6
            # 60 + 5 seconds were expected, 20 are over; the steps go by their own pace.
            assert shown["[2/4] Fitting [bold]"].fields["left"] == ", about 0:45 left"
            assert shown["  steps"].fields["left"] == ", about 0:07 left"
            clock.now += 1000.0
            update(7)
            assert shown["[2/4] Fitting [bold]"].fields["left"] == ", about 0:05 left"
        assert [task.description for task in view._bars.tasks] == ["[2/4] Fitting [bold]"]
    assert OUTER.get() is None
    assert "Fitting [bold]" in capsys.readouterr().err
