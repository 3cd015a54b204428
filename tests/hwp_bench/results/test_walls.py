"""Runs without walls are named on the console and below tables. Oracle: the made results."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest
from small_captures import results_example

from hwp_bench.analysis.cost import machine_notes
from hwp_bench.base.tables import to_markdown
from hwp_bench.evaluation.sentences import outcome_lines
from hwp_bench.report.tables import all_tables
from hwp_bench.results import Results
from hwp_bench.results.schema import add_isolation_note, isolation_note, isolation_text


def _made(isolation: str | None, name: str = "plain") -> Results:
    results = results_example(name)
    captures = [replace(capture, isolation=isolation) for capture in results.captures]
    return replace(results, captures=captures)


def test_the_console_says_the_level_on_every_run(tmp_path: Path) -> None:
    clock = "2.0 s of fitting, by the method's clock; processes ran 4.0 s"
    lines = outcome_lines(tmp_path, _made("namespaces"))
    assert lines == [f"times: {clock}", "isolation: namespaces"]
    refused = _made("processes (new namespaces: No space)")
    times, line = outcome_lines(tmp_path, refused, "v, seed 0, ")
    assert times == f"times: v, seed 0, {clock}"
    assert line.startswith(
        "warning: v, seed 0, no isolation on capture2 (the system refuses them: "
        "new namespaces: No space). "
    )
    assert isolation_text(_made("processes")).startswith("warning: no isolation on capture2. ")
    assert isolation_text(_made(None)) == ""


@pytest.mark.parametrize("isolation", ["processes", "processes (mount of /usr: refused)"])
def test_every_table_names_methods_that_ran_without_walls(isolation: str) -> None:
    walled, bare = _made("namespaces", "honest"), _made(isolation, "bare")
    note = "Run without walls, where test frames can be read: Bare."
    for table in all_tables([walled, bare]).values():
        assert table.notes.count(note) == 1
        assert note in to_markdown(table)
        assert add_isolation_note(table, [bare]) == table
    assert machine_notes([walled, bare])[-1] == note
    for kind in ("namespaces", None):
        assert isolation_note([_made(kind)]) == ""
        assert not any(
            "walls" in text for t in all_tables([_made(kind)]).values() for text in t.notes
        )
