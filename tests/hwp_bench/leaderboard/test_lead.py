"""The reference against its best competitor. Oracle: constructed scores."""

from __future__ import annotations

from dataclasses import replace

import pytest
from made_entries import complete_results

from hwp_bench.leaderboard.board_rows import board_rows
from hwp_bench.leaderboard.entries import make_entry
from hwp_bench.leaderboard.lead import reference_lead


def entry(name: str, level: float, *, seed: int = 0, seconds: float | None = None, noise=0.0):
    """Every capture scores the level; noise moves every second capture up, the others down."""
    results = complete_results(
        name,
        lambda capture, frame: level + noise * (-1.0) ** capture + 0.01 * (frame % 3),
        suite_name="mini",
    )
    budget = {"seconds": seconds, "steps": None}
    return make_entry(replace(results, seed=seed, budget=budget))


def lead(*entries) -> str:
    return reference_lead(board_rows(entries))


def test_the_reference_ahead_of_the_best_of_the_others() -> None:
    text = lead(entry("plain", 24.0), entry("wildghand", 27.5), entry("other", 25.0))
    assert text.startswith("Wildghand is 2.50 dB ahead of Other, the best other method")
    assert "on mini (95 % interval +2.50 to +2.50)." in text


def test_the_reference_behind_is_said_as_plainly() -> None:
    text = lead(entry("wildghand", 24.0), entry("other", 25.0))
    assert text.startswith("Wildghand is 1.00 dB behind Other")
    assert "(95 % interval -1.00 to -1.00)." in text


def test_a_lead_that_captures_do_not_share_is_not_significant() -> None:
    text = lead(entry("wildghand", 25.1, noise=3.0), entry("other", 25.0, noise=-3.0))
    assert text.endswith("not significant).")


@pytest.mark.parametrize("seconds", [16.0, 40.0])
def test_only_rows_of_the_same_budget_are_compared(seconds: float) -> None:
    entries = [
        entry("wildghand", 30.0, seconds=40.0),
        entry("wildghand", 27.0, seconds=16.0),
        entry("plain", 24.0, seconds=seconds),
    ]
    difference = {16.0: "3.00", 40.0: "6.00"}[seconds]
    assert f"is {difference} dB ahead of Plain" in lead(*entries)


def test_nothing_is_said_without_a_competitor_or_a_common_seed() -> None:
    assert lead() == ""
    assert lead(entry("wildghand", 30.0)) == ""
    assert lead(entry("plain", 30.0), entry("other", 20.0)) == ""
    assert lead(entry("wildghand", 30.0, seconds=16.0), entry("plain", 24.0)) == ""
    assert lead(entry("wildghand", 30.0), entry("plain", 24.0, seed=1)) == ""


def test_an_incomplete_row_is_no_competitor() -> None:
    best = entry("other", 29.0)
    short = make_entry(replace(best.results, captures=best.results.captures[1:]))
    assert "ahead of Plain" in lead(entry("wildghand", 27.0), entry("plain", 24.0), short)
