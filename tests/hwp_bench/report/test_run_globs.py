"""`table`, `cost` and `report` take the same `runs/*`. Oracle: what lies in such a folder."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest
from small_captures import results_example

from hwp_bench.cli.main import main
from hwp_bench.results import write_results

COMMANDS = (["table"], ["table", "--by", "rank"], ["cost"], ["report"])


@pytest.fixture
def runs(tmp_path: Path) -> Path:
    """Two data sets, an oracle, a second run, a folder of figures, a note."""
    root = tmp_path / "runs"
    results = {
        "plain": results_example("plain", 20.0, "d"),
        "mine": results_example("mine", 22.0, "d"),
        "clean": replace(results_example("mine", 25.0, "d"), frames="clean"),
        "other": results_example("plain", 19.0, "e"),
        "second": replace(results_example("plain", 20.1, "d"), started="2026-02-02T00:00:00+00:00"),
    }
    for name, result in results.items():
        write_results(root / name / "results.json", result)
    (root / "cost").mkdir()
    (root / "cost" / "pareto.svg").write_text("<svg/>")
    (root / "notes.txt").write_text("to do")
    return root


@pytest.mark.parametrize("command", COMMANDS, ids=" ".join)
def test_a_whole_folder_of_runs_is_taken(command: list[str], runs: Path, capsys) -> None:
    words = [*command, *(str(path) for path in sorted(runs.iterdir()))]
    if command[0] != "table":
        words += ["-o", str(runs.parent / "out")]
    assert main(words) == 0
    said = capsys.readouterr()
    assert f"left out: {runs / 'cost'} holds no results" in said.err
    assert f"left out: {runs / 'notes.txt'} holds no results" in said.err
    if command != ["table"]:
        assert f"left out: {runs / 'second'} repeats {runs / 'plain'}" in said.err
    if command[0] == "report":
        text = (runs.parent / "out" / "index.html").read_text()
        assert "A/index.html" in text
        assert "B/index.html" in text
    else:
        assert "Data" in said.out


@pytest.mark.parametrize("command", COMMANDS, ids=" ".join)
def test_nothing_but_other_files_is_an_error(command: list[str], runs: Path, capsys) -> None:
    extra = [] if command[0] == "table" else ["-o", str(runs.parent / "out")]
    assert main([*command, str(runs / "cost"), str(runs / "notes.txt"), *extra]) == 1
    assert "results.json: does not exist" in capsys.readouterr().err
