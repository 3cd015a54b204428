"""Mixed results: tables, cost and reports of each data apart. Oracle: constructed results."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import pytest
from made_results import made_results
from small_captures import results_example

from hwp_bench.analysis.pairing import group_runs
from hwp_bench.base.errors import HwpError, UsageError
from hwp_bench.base.tables import Column, Table
from hwp_bench.cli.main import main
from hwp_bench.report.requested_table import TableRequest, make_table
from hwp_bench.report.sources import (
    DataGroup,
    ResultsSource,
    data_groups,
    find_captures,
    read_sources,
    stacked,
)
from hwp_bench.report.study_tables import cost_table, on_front
from hwp_bench.results import write_results


def level(psnr: float):
    """A scorer of one level."""
    return lambda capture, frame, seed: psnr + 0.1 * capture


@pytest.fixture
def mixed(tmp_path: Path) -> list[str]:
    """Two methods on four captures, two on two captures; the second data have higher scores."""
    rows = [
        made_results("plain", level(20.0)),
        made_results("plain", level(30.0), captures=2),
        made_results("mine", level(25.0)),
        made_results("mine", level(28.0), captures=2),
    ]
    paths = []
    for number, row in enumerate(rows):
        paths.append(str(write_results(tmp_path / f"r{number}" / "results.json", row).parent))
    return paths


def test_what_makes_data_the_same() -> None:
    base = made_results("a", level(20.0))
    capture = base.captures[0]
    others = [
        replace(base, captures=[replace(capture, digest="e"), *base.captures[1:]]),
        replace(base, captures=[replace(capture, split_digest="e"), *base.captures[1:]]),
        replace(base, captures=[replace(capture, frames=capture.frames[1:]), *base.captures[1:]]),
        replace(base, captures=base.captures[1:]),
        replace(base, protocols={"hwp-v2": {}}),
    ]
    clean = replace(base, frames="clean")
    turned = replace(base, captures=base.captures[::-1], seed=4)
    sources = [ResultsSource(item, None) for item in (base, *others, clean, turned)]
    groups = data_groups(sources)
    assert [group.label for group in groups] == list("ABCDEFG")
    assert [len(group.sources) for group in groups] == [2, 1, 1, 1, 1, 1, 1]
    assert groups[6].text.endswith("clean training frames")
    assert len(data_groups(sources, oracles=True)) == 6
    assert [group.label for group in data_groups(sources[:1])] == [""]


def test_a_best_is_marked_within_the_same_data(mixed) -> None:
    for by in ("overall", "perturbations", "captures", "details", "micro", "cost", "seeds", "rank"):
        table = make_table(TableRequest(mixed, by))
        assert table.columns[0].title == "Data"
        column = next(i for i, c in enumerate(table.columns) if "PSNR" in c.group + c.title)
        if by in ("seeds", "cost"):
            column = next(i for i, c in enumerate(table.columns) if c.higher_is_better)
        best = {row[:3] for i, row in enumerate(table.rows) if table.rank(i, column) == 0}
        assert {cells[0] for cells in best} == {"A", "B"}
        titles = {(cells[0], "Mine" if "Mine" in cells else "Plain") for cells in best}
        if by != "captures":
            assert titles == {("A", "Mine"), ("B", "Plain")}
    notes = "\n".join(make_table(TableRequest(mixed)).notes)
    assert "only rows of the same data are ranked together" in notes
    assert "Data B: smoke, 2 captures, 12 test frames" in notes
    assert "A: Mine wins with PSNR" in notes
    assert "+5.00 dB against Plain" in notes
    assert "+2.00 dB against Mine" in notes


def test_a_run_that_is_given_twice_stops_no_table(mixed) -> None:
    notes = make_table(TableRequest([mixed[0], mixed[0], mixed[2]])).notes
    assert notes[0].startswith("Nobody is named as the winner: two results are of Plain")


def test_the_same_run_on_another_split_is_no_repeat(tmp_path: Path) -> None:
    base = made_results("mine", level(20.0))
    other = replace(base, captures=[replace(c, split_digest="e") for c in base.captures])
    paths = [
        write_results(tmp_path / name / "results.json", row).parent
        for name, row in (("a", base), ("b", other), ("again", base))
    ]
    kept = read_sources(paths, repeats=False)
    assert [source.folder for source in kept] == paths[:2]
    with pytest.raises(UsageError, match="different splits under the name"):
        group_runs([base, other])


def test_captures_of_two_versions_of_an_importer_are_named(tmp_path: Path, capsys) -> None:
    paths = []
    for number, maker in enumerate(("video 1", "video 2", "video 2")):
        base = made_results(f"m{number}", level(20.0), captures=1)
        capture = replace(base.captures[0], made_by=maker, digest=maker)
        row = replace(base, captures=[capture])
        paths.append(str(write_results(tmp_path / f"v{number}" / "results.json", row).parent))
    assert main(["table", *paths, "--format", "md"]) == 0
    warning = "capture0 was made by different importers (video 1, video 2)"
    assert warning in capsys.readouterr().out
    assert main(["table", *paths[1:], "--format", "md"]) == 0
    assert "different importers" not in capsys.readouterr().out


def test_a_capture_that_was_named_is_never_passed_over(make_capture, tmp_path, capsys) -> None:
    results, other = made_results("mine", level(20.0)), make_capture("other")
    with pytest.raises(HwpError, match="nowhere"):
        find_captures([results], [tmp_path / "nowhere"])
    assert find_captures([results], [other.root]) == {}
    assert f"{other.root} is not a capture of these results" in capsys.readouterr().err


def test_tables_with_other_columns_are_put_under_one_another() -> None:
    first = Table("T", (Column("M"), Column("x", 1, True, "G")), (("a", 1.0), ("b", 2.0)), ("n",))
    second = Table(
        "T",
        (Column("M"), Column("x", 1, True, "G"), Column("y", 1, True, "G"), Column("z")),
        (("a", 3.0, 4.0, "t"), ("b", 1.0, 2.0, "t"), ("p", 9.0, 9.0, "t")),
        ("n", "m"),
        breaks=(2,),
        unranked=frozenset({2}),
    )
    groups = [DataGroup(label, f"text {label}", ()) for label in "AB"]
    table = stacked(groups, [first, second])
    assert [(c.group, c.title) for c in table.columns] == [
        ("", "Data"),
        ("", "M"),
        ("G", "x"),
        ("G", "y"),
        ("", "z"),
    ]
    assert table.rows[0] == ("A", "a", 1.0, None, None)
    assert table.rows[4] == ("B", "p", 9.0, 9.0, "t")
    assert (table.breaks, table.unranked) == ((2, 4), frozenset({4}))
    assert [table.rank(row, 2) for row in range(5)] == [1, 0, 0, 1, None]
    assert table.notes[1:] == ("Data A: text A.", "Data B: text B.", "n", "B: m")
    unranked = stacked(groups, [first, replace(first, ranked=False)])
    assert [unranked.rank(row, 2) for row in range(4)] == [1, 0, None, None]
    assert stacked(groups[:1], [first]) is first


def test_the_commands_take_mixed_results(mixed, tmp_path: Path, capsys) -> None:
    capsys.readouterr()
    assert main(["table", *mixed, "--json"]) == 0
    rows = json.loads(capsys.readouterr().out)["rows"]
    assert [row["Data"] for row in rows] == ["A", "A", "B", "B"]
    assert main(["table", *mixed, "--by", "severity"]) == 2
    assert main(["curves", *mixed, "-o", str(tmp_path / "cost"), "--json"]) == 0
    groups = json.loads(capsys.readouterr().out)["groups"]
    assert [(group["data"], len(group["methods"])) for group in groups] == [("A", 2), ("B", 2)]
    assert (tmp_path / "cost" / "B" / "pareto.png").is_file()
    assert main(["curves", *mixed[::2], "-o", str(tmp_path / "one"), "--json"]) == 0
    assert "groups" not in json.loads(capsys.readouterr().out)
    assert (tmp_path / "one" / "pareto.png").is_file()
    assert main(["report", *mixed, "-o", str(tmp_path / "report")]) == 0
    index = (tmp_path / "report" / "index.html").read_text("utf-8")
    for label in "AB":
        assert f'href="{label}/index.html"' in index
        assert (tmp_path / "report" / label / "index.html").is_file()
    assert "Mine wins with PSNR" in index
    assert main(["report", *mixed, "-o", str(tmp_path / "r"), "--baseline", "nobody"]) == 2
    assert "no result is of 'nobody'" in capsys.readouterr().err
    # One data: one page, as always.
    assert main(["report", *mixed[::2], "-o", str(tmp_path / "same")]) == 0
    assert not (tmp_path / "same" / "A").exists()


def test_the_front_and_what_a_score_costs() -> None:
    from hwp_bench.analysis.pairing import group_runs

    rows = [
        made_results("quick", level(20.0), seconds=5.0),
        made_results("good", level(25.0), seconds=20.0),
        made_results("slow", level(24.0), seconds=40.0),
        made_results("twin", level(25.0), seconds=20.0),
    ]
    spent = [replace(c, cpu_seconds=8.0 + i) for i, c in enumerate(rows[0].captures)]
    table = cost_table(group_runs([replace(rows[0], captures=spent), *rows[1:]]))
    names = [f"{column.group} {column.title}".strip() for column in table.columns]
    cells = [dict(zip(names, row, strict=True)) for row in table.rows]
    assert [row["Front"] for row in cells] == ["yes", "yes", None, "yes"]
    assert [row["Cost Fit [s]"] for row in cells] == [5.0, 20.0, 40.0, 20.0]
    assert [row["Cost One core [s]"] for row in cells] == [9.5, None, None, None]
    assert cells[0]["Cost Memory [GB]"] == pytest.approx(0.1)
    assert cells[0]["PSNR [dB] Test"] == pytest.approx(20.15)
    assert not on_front(replace_seconds(group_runs(rows[:1])), 20.0, [], [])


def replace_seconds(runs):
    """The cost of a method that does not say how long it took."""
    from hwp_bench.analysis.cost import method_costs

    return replace(method_costs(runs, "psnr")[0], fit_seconds=None)


COMMANDS = (["table"], ["table", "--by", "rank"], ["curves"], ["report"])


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


def test_a_base_that_is_not_there_or_has_no_effect_is_refused(runs: Path, capsys) -> None:
    words = [str(runs / "plain"), str(runs / "mine"), "--baseline", "nobody"]
    assert main(["report", *words, "-o", str(runs.parent / "out")]) == 2
    assert "no result is of 'nobody'" in capsys.readouterr().err
    assert main(["table", *words]) == 2
    assert "--baseline: the table 'overall' has none" in capsys.readouterr().err


@pytest.mark.parametrize("command", COMMANDS, ids=" ".join)
def test_nothing_but_other_files_is_an_error(command: list[str], runs: Path, capsys) -> None:
    extra = [] if command[0] == "table" else ["-o", str(runs.parent / "out")]
    assert main([*command, str(runs / "cost"), str(runs / "notes.txt"), *extra]) == 1
    assert "results.json: does not exist" in capsys.readouterr().err
