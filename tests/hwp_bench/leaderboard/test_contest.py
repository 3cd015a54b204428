"""Contested entries. Oracle: constructed scores of an entry and of a second run of its method."""

from __future__ import annotations

import json
import re
from dataclasses import replace
from pathlib import Path

import pytest
from made_entries import complete_results, page_of, with_keys

from hwp_bench.base.errors import BadResult, UsageError
from hwp_bench.base.files import sha256_json
from hwp_bench.cli.main import main
from hwp_bench.leaderboard.board import board_tables, method_rows
from hwp_bench.leaderboard.entries import (
    Entry,
    digest,
    make_entry,
    read_entries,
    write_check,
    write_entry,
)
from hwp_bench.leaderboard.rules import check_bound, sound_entries, without_false_checks
from hwp_bench.leaderboard.site import method_pages, write_method_pages
from hwp_bench.leaderboard.submit import contest
from hwp_bench.results import Results, write_results

NAME = "mine"


def run(level: float, day: int = 2, **changes: object) -> Results:
    """A run of the method whose frames all score the level."""
    return complete_results(NAME, level, started=f"2026-01-0{day}T00:00:00+00:00", **changes)


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """Entries of a method at 24 dB and of another at 22 dB, and two more runs of the first."""
    for results in (run(24.0, 1), complete_results("other", 22.0)):
        write_entry(tmp_path / "entries", make_entry(results))
    for level in (20.0, 26.0):
        write_results(tmp_path / f"at{level:g}" / "results.json", run(level))
    return tmp_path / "entries"


def own(folder: Path) -> Entry:
    """The entry of the method."""
    (found,) = (one for one in sound_entries(folder) if one.results.method.name == NAME)
    return found


def call(folder: Path, rerun: object, *more: str) -> int:
    words = [
        "dev",
        "leaderboard",
        "contest",
        own(folder).name,
        str(rerun),
        "--checked-by",
        "B",
        "--reason",
        "so",
    ]
    return main([*words, "--entries", str(folder), *more])


def test_a_contest_stands_beside_the_entry_and_the_lower_score_counts(
    folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    before = {file.name: file.read_bytes() for file in folder.glob("*.json")}
    assert call(folder, tmp_path / "at20") == 0
    rerun = digest(run(20.0))
    assert f"PSNR 24.00 dB, contested by {rerun[:8]}: 20.00 dB" in capsys.readouterr().out
    assert {file.name: file.read_bytes() for file in folder.glob("*.json")} == before
    entry = own(folder)
    (made,) = entry.contests
    assert (made.entry_digest, made.rerun, made.by, made.reason) == (entry.digest, rerun, "B", "so")
    assert (entry.badge, entry.counted, entry.results) == ("contested", run(20.0), run(24.0, 1))
    # The other method is ahead as long as the contest is open.
    (table,) = board_tables(sound_entries(folder))
    assert [(row[0], row[1]) for row in table.rows] == [("Other", 1), ("Mine", 2)]
    assert main(["leaderboard", "check", "--entries", str(folder)]) == 0
    page = page_of(sound_entries(folder))
    assert ">contested</a></td>" in page
    assert re.search(r'data-key="psnr".*>20\.00</td>', page)
    assert ">24.00</td>" not in page
    rows = method_rows(sound_entries(folder))
    write_method_pages(tmp_path, method_pages(rows))
    (text,) = (file.read_text("utf-8") for file in (tmp_path / "methods").glob("*-mine.html"))
    for part in (entry.digest, rerun, "24.00 dB", "20.00 dB", "Open."):
        assert part in text


def test_a_contest_with_a_higher_score_lifts_no_row(folder: Path, tmp_path: Path) -> None:
    assert call(folder, tmp_path / "at26") == 0
    assert own(folder).badge == "contested"
    assert own(folder).counted == run(24.0, 1)


def test_either_can_be_withdrawn(folder: Path, tmp_path: Path) -> None:
    assert call(folder, tmp_path / "at20") == 0
    assert call(folder, tmp_path / "at26") == 0
    assert call(folder, digest(run(20.0))[:8], "--withdraw", "rerun") == 0
    entry = own(folder)
    assert [one.rerun for one in entry.open_contests] == [digest(run(26.0))]
    assert (entry.badge, entry.counted.scores["psnr"]) == ("contested", pytest.approx(24.0))
    assert call(folder, digest(run(26.0))[:8], "--withdraw", "rerun") == 0
    assert own(folder).badge == "not tried"
    assert len(list((folder / "contests").glob("*.json"))) == 4
    # A withdrawn entry has no row; where another one of the method stands, that is the row.
    assert call(folder, digest(run(26.0))[:8], "--withdraw", "entry") == 0
    assert [row.title for row in method_rows(sound_entries(folder))] == ["Other"]
    write_entry(folder, make_entry(run(23.0, 3)))
    (mine, _) = sorted(method_rows(sound_entries(folder)), key=lambda row: row.title)
    assert mine.first == run(23.0, 3)
    assert mine.why_older(mine.older[0]) == "withdrawn by B: so"
    assert main(["leaderboard", "check", "--entries", str(folder)]) == 0


def test_the_withdrawal_of_a_false_contest_is_left_out_with_it(
    folder: Path, tmp_path: Path
) -> None:
    assert call(folder, tmp_path / "at20") == 0
    assert call(folder, digest(run(20.0))[:8], "--withdraw", "rerun") == 0
    entry = own(folder)
    (made,) = (one for one in entry.contests if one.results is not None)
    (answer,) = (one for one in entry.contests if one.results is None)
    false = replace(made, date="2099" + made.date[4:])
    kept = without_false_checks(replace(entry, contests=(false, answer)))
    assert kept.contests == ()
    check_bound(kept)


@pytest.mark.parametrize(
    "results",
    [
        run(20.0, 1),
        with_keys(replace(run(20.0), seed=1)),
        with_keys(replace(run(20.0), budget={"seconds": 9.0, "steps": None})),
        complete_results("third", 20.0),
        replace(run(20.0), captures=run(20.0).captures[1:]),
    ],
    ids=["itself", "another seed", "another budget", "another method", "a part"],
)
def test_only_a_whole_second_run_of_the_same_method_contests(
    folder: Path, tmp_path: Path, results: Results, capsys: pytest.CaptureFixture[str]
) -> None:
    write_results(tmp_path / "x" / "results.json", results)
    assert call(folder, tmp_path / "x") == 1
    assert "is contested by a run of another method" in capsys.readouterr().err
    assert not (folder / "contests").exists()


@pytest.mark.parametrize("option", ["--reason", "--checked-by"])
@pytest.mark.parametrize("text", ["", "a\nb"])
def test_what_a_contest_cannot_hold_is_refused(
    folder: Path, tmp_path: Path, option: str, text: str
) -> None:
    assert call(folder, tmp_path / "at20", option, text) == 2
    assert not (folder / "contests").exists()


def test_one_run_contests(folder: Path, tmp_path: Path, capsys) -> None:
    for seed in (0, 1):
        results = with_keys(replace(run(20.0), seed=seed))
        write_results(tmp_path / "both" / f"seed-{seed}" / "results.json", results)
    assert call(folder, tmp_path / "both") == 2
    assert "has 2 results" in capsys.readouterr().err


def test_a_file_that_is_no_result_is_refused(folder: Path, tmp_path: Path, capsys) -> None:
    for text in ("[]", "{}", '{"schema": "hwp-entry/1"}'):
        file = tmp_path / "other.json"
        file.write_text(text)
        assert call(folder, file) == 1
        assert str(file) in capsys.readouterr().err


def test_unsound_runs_and_edited_files_are_refused(folder: Path, tmp_path: Path) -> None:
    entry = own(folder)
    unsound = replace(run(20.0), captures=[replace(c, key="k") for c in run(20.0).captures])
    file = write_results(tmp_path / "x" / "results.json", unsound)
    with pytest.raises(BadResult, match="is not the key"):
        contest(entry, file, by="B", reason="so")
    made = contest(entry, tmp_path / "at20" / "results.json", by="B", reason="so")
    path = write_check(folder, made)
    whole = json.loads(path.read_text("utf-8"))

    def edited(change: str, value: object, *, fit: bool) -> None:
        new = json.loads(json.dumps(whole))
        new["contest"][change] = value
        if fit:
            new["digest"] = sha256_json(new["contest"])
        path.write_text(json.dumps(new))

    for change, value, fit, problem in (
        ("reason", "else", False, "was changed by hand"),
        ("rerun", "0" * 64, True, "is not the digest of its results"),
        ("results", None, True, "must have exactly one of results and withdraws"),
        ("withdraws", "all", True, "withdraws"),
        ("entry", "nobody", True, "which is not there"),
        ("date", "2999-01-01T00:00:00+00:00", True, None),
    ):
        edited(change, value, fit=fit)
        if problem:
            with pytest.raises(BadResult, match=problem):
                read_entries(folder)
        assert main(["leaderboard", "check", "--entries", str(folder)]) != 0
        # On the board it is left out, and the entry stands as it was.
        assert own(folder).badge == "not tried"


def test_a_withdrawal_names_a_contest(folder: Path, tmp_path: Path) -> None:
    entry = own(folder)
    with pytest.raises(UsageError, match="is not one re-evaluation"):
        contest(entry, "0123abcd", by="B", reason="so", withdraws="rerun")
    made = contest(entry, tmp_path / "at20" / "results.json", by="B", reason="so")
    alone = replace(made, results=None, withdraws="entry")
    with pytest.raises(BadResult, match="which does not contest the entry"):
        check_bound(replace(entry, contests=(alone,)))
    check_bound(replace(entry, contests=(made, alone)))
