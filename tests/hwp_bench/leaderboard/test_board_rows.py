"""Rows of several seeds. Oracle: means of constructed scores, and constructed checks."""

from __future__ import annotations

from dataclasses import replace

import pytest
from made_entries import check_of, complete_results

from hwp_bench.leaderboard.board_rows import board_rows, method_rows
from hwp_bench.leaderboard.entries import make_entry
from hwp_bench.leaderboard.records import Submission
from hwp_bench.leaderboard.standings import board_tables


def results(name: str, level: float, seed: int):
    """Every frame of a method scores its level, which moves by a decibel from seed to seed."""
    found = complete_results(name, lambda capture, frame: level + seed, suite_name="mini")
    return replace(found, seed=seed)


def test_entries_that_differ_in_the_seed_alone_are_one_row_of_means() -> None:
    mine = [make_entry(results("mine", 24.0, seed)) for seed in (2, 0, 1)]
    plain = make_entry(results("plain", 20.0, 0))
    (table,) = board_tables([mine[0], plain, *mine[1:]])
    columns = [column.title for column in table.columns]
    rows = [dict(zip(columns, row, strict=True)) for row in table.rows]
    assert [(row["Method"], row["Seeds"]) for row in rows] == [("Mine", 3), ("Plain", 1)]
    assert table.rows[0][columns.index("95 %") + 1] == pytest.approx(25.0)
    assert rows[0]["Entry"] == f"{mine[1].name} and 2 more"
    assert table.notes[0].startswith("Mine wins with PSNR ")


def test_another_budget_is_another_row() -> None:
    first = results("mine", 24.0, 0)
    longer = replace(results("mine", 24.0, 1), budget={"seconds": 99.0})
    assert [row.seeds for row in board_rows(map(make_entry, (first, longer)))] == [(0,), (1,)]


def test_an_incomplete_entry_and_a_second_one_of_a_seed_stand_alone() -> None:
    whole = make_entry(results("mine", 24.0, 0))
    short = make_entry(replace(results("mine", 24.0, 1), captures=whole.results.captures[1:]))
    twin = make_entry(whole.results, Submission(by="B"))
    rows = board_rows([whole, short, twin])
    assert [row.entries for row in rows] == [(whole,), (short,), (twin,)]
    assert [row.whole for row in rows] == [True, False, True]


def test_a_row_was_checked_as_far_as_every_one_of_its_entries() -> None:
    first, second = (make_entry(results("mine", 24.0, seed)) for seed in (0, 1))
    first = replace(first, checks=(check_of(first, "re-run", "reproduces"),))
    # A seed that was checked less far is no part of a row.
    assert [(row.level, row.badge) for row in board_rows([first, second])] == [
        ("re-run", "reproduces"),
        ("self-reported", "not tried"),
    ]
    checks = check_of(second, "rescored", "reproduces"), check_of(second, "re-run", "reproduces")
    (row,) = board_rows([first, replace(second, checks=checks)])
    assert (row.level, row.badge) == ("re-run", "reproduces")
    checks = check_of(second, "rescored", "differs"), check_of(second, "re-run", "reproduces")
    (row,) = board_rows([first, replace(second, checks=checks)])
    assert (row.level, row.badge) == ("re-run", "differs")


def test_a_stranger_moves_no_row_by_a_seed_or_a_revision() -> None:
    """A checked row of 24 dB, and entries of 5 dB of others, or of less checked runs."""
    mine = make_entry(results("mine", 24.0, 0), Submission(by="A"))
    checked = replace(mine, checks=(check_of(mine),))
    why = {"revises": mine.name, "reason": "better"}
    for number, (seed, added) in enumerate(
        [
            (7, Submission(by="A")),
            (0, Submission(by="A", **why)),
            (7, Submission(by="B")),
            (0, Submission(by="B", **why)),
        ]
    ):
        other = make_entry(results("mine", 5.0, seed), added)
        own, *strange = method_rows([other, checked] if number % 2 else [checked, other])
        if added.by == "B":
            named = {method.label for method in (own, *strange)}
            assert named == {"Mine (by A)", "Mine (by B)"}
            own = next(m for m in (own, *strange) if m.row.entries == (checked,))
            assert not own.older
        else:
            assert own.older == (other,)
        assert own.row.entries == (checked,)
        # What was checked as far, and is of the same submitter, does take the place.
        revised = replace(other, checks=(check_of(other),))
        taken = any(method.row.entries == (revised,) for method in method_rows([checked, revised]))
        assert taken == (added.by == "B" or seed == 0)


def test_the_row_of_a_method_is_its_newest_and_the_others_are_its_history() -> None:
    runs = [
        make_entry(
            replace(
                results("mine", 20.0 + day, 0),
                started=f"2026-01-0{day}T00:00:00+00:00",
                budget={"seconds": float(day), "steps": None},
            )
        )
        for day in (2, 3, 1)
    ]
    (method,) = method_rows(runs)
    assert method.label == "Mine"
    assert method.row.entries == (runs[1],)
    assert method.older == (runs[0], runs[2])
    # A run that was checked stays ahead of newer ones that were not.
    checked = replace(runs[2], checks=(check_of(runs[2]),))
    (method,) = method_rows([*runs[:2], checked])
    assert method.row.entries == (checked,)


def test_seconds_are_means_over_seeds_or_unknown() -> None:
    def timed(seed: int, seconds: float | None):
        made = results("mine", 24.0, seed)
        captures = tuple(replace(one, fit_seconds=seconds) for one in made.captures)
        return make_entry(replace(made, captures=captures))

    (row,) = board_rows([timed(0, 10.0), timed(1, 20.0)])
    assert row.fit_seconds == pytest.approx(15.0)
    (row,) = board_rows([timed(0, None)])
    assert row.fit_seconds is None
