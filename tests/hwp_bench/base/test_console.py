"""Progress of jobs. Oracle: what a person would read of it."""

from __future__ import annotations

import sys

import pytest
from stopped_clock import Clock, stop_clock

from hwp_bench.base.console import OUTER, JobsView, StagesView, progress, track


@pytest.fixture
def clock(monkeypatch: pytest.MonkeyPatch) -> Clock:
    """The clock that progress looks at."""
    return stop_clock(monkeypatch, "hwp_bench.base.console")


@pytest.mark.parametrize(
    ("reached", "said"), [(116, "116 of 2000 in 65.0 s"), (2000, "2000 in 65.0 s")]
)
def test_work_that_ends_early_says_how_far_it_came(
    reached: int, said: str, clock: Clock, capsys
) -> None:
    with progress("Fitting", 2000) as update:
        update(100)
        update(reached)
        clock.now += 65.0
    assert capsys.readouterr().err == f"Fitting: {said}\n"


@pytest.mark.parametrize("terminal", [False, True])
def test_jobs_are_told_of_once_each(terminal: bool, clock: Clock, capsys, monkeypatch) -> None:
    monkeypatch.setattr(sys.stderr, "isatty", lambda: terminal)
    with JobsView() as view:
        view.begin(3)
        view.start(0, "one [bold]", "a")
        view.start(1, "two", "b")
        view.steps(0, 3, 4)
        view.steps(2, 1, 4)
        view.start(1, "two", "c")
        clock.now += 65.0
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
        assert "[1 of 3 ended, 1:05 elapsed] one [bold] in 1:05" in captured.err
        assert "[3 of 3 ended, 1:05 elapsed] three" in captured.err


@pytest.mark.parametrize("terminal", [False, True])
def test_jobs_in_turn_are_told_of_once_each(
    terminal: bool, clock: Clock, capsys, monkeypatch
) -> None:
    monkeypatch.setattr(sys.stderr, "isatty", lambda: terminal)
    with JobsView() as view:
        for index, name in enumerate(("one [bold]", "two", "three")):
            step = view.turn(index, 3, name)
            step(1, 2)
            clock.now += 30.0
            step(2, 2)
    captured = capsys.readouterr()
    assert captured.out == ""
    if terminal:
        assert "[3] three" in captured.err
        assert "2/3" in captured.err
    else:
        assert captured.err.splitlines() == [
            "[1/3] one [bold] (0:00 elapsed)",
            "[2/3] two (0:30 elapsed, about 1:00 left)",
            "[3/3] three (1:00 elapsed, about 0:30 left)",
        ]


def test_a_quiet_view_shows_nothing(capsys) -> None:
    with JobsView(quiet=True) as view:
        view.turn(0, 1, "one")(1, 1)
        view.say("more")
    assert capsys.readouterr().err == ""


@pytest.mark.parametrize("terminal", [False, True])
def test_one_piece_of_work_is_a_bar_or_a_line(
    terminal: bool, clock: Clock, capsys, monkeypatch
) -> None:
    monkeypatch.setattr(sys.stderr, "isatty", lambda: terminal)
    assert list(track("abc", "reading [bold]")) == ["a", "b", "c"]
    shown = capsys.readouterr().err
    if terminal:
        assert "reading [bold]" in shown
        assert "3/3" in shown
    else:
        assert shown == "reading [bold]: 3 in 0.0 s\n"


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


def test_what_is_printed_while_a_bar_is_shown_stays_on_standard_output(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(sys.stderr, "isatty", lambda: True)
    for name in track("ab", "checking"):
        print(name)
    assert capsys.readouterr().out == "a\nb\n"
