"""Leaderboard entries and checks of older versions are read for ever. Oracle: the files."""

from __future__ import annotations

import json
from pathlib import Path

from hwp_bench.leaderboard.entries import Submission, read_entries
from hwp_bench.leaderboard.rules import current, history

HERE = Path(__file__).parent / "leaderboard"


def test_an_entry_without_a_submission_keeps_its_name_and_its_digest() -> None:
    files = {file.stem: json.loads(file.read_text("utf-8")) for file in HERE.glob("*.json")}
    entries = {entry.name: entry for entry in read_entries(HERE)}
    assert entries.keys() == files.keys()
    for name, value in files.items():
        assert value["schema"] == "hwp-leaderboard-entry/1"
        assert entries[name].digest == value["digest"]
    (oldest,) = (name for name, value in files.items() if "submission" not in value)
    assert entries[oldest].submission == Submission()
    assert (entries[oldest].level, entries[oldest].badge) == ("self-reported", "not tried")


def test_revisions_and_checks_of_version_1_are_read() -> None:
    entries = read_entries(HERE)
    (row,) = current(entries)
    assert row.submission.reason == "the avatars were not named"
    assert [entry.name for entry in history(row, entries)] == [row.submission.revises]
    # It was rescored, and a later run of the method had another score.
    assert {check.kind for check in row.checks} == {"rescored", "re-run"}
    assert (row.level, row.badge) == ("rescored", "differs")
