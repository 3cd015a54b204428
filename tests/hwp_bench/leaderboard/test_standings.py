"""Ranks on the terminal and on the site. Oracle: constructed scores."""

from __future__ import annotations

import json
import re
from dataclasses import replace
from pathlib import Path

import pytest
from made_entries import check_of, complete_results, page_of

from hwp_bench.cli.main import main
from hwp_bench.leaderboard.entries import make_entry, write_check, write_entry
from hwp_bench.leaderboard.records import Submission
from hwp_bench.leaderboard.standings import board_tables


def scorer(level: float):
    """Captures differ by a tenth of a decibel, and methods by their level."""
    return lambda capture, frame: level + 0.1 * capture + 0.01 * (frame % 2)


@pytest.fixture
def entries():
    """Three methods on mini, one of them revised; one row lacks a capture, one is of hwp-v0."""
    first = make_entry(complete_results("mine", scorer(24.0), suite_name="mini"))
    again = Submission(revises=first.name, reason="one camera was wrong")
    second = make_entry(complete_results("mine", scorer(26.0), suite_name="mini"), again)
    plain = make_entry(complete_results("plain", scorer(25.0), suite_name="mini"))
    short = complete_results("short", scorer(30.0), suite_name="mini")
    short_entry = make_entry(replace(short, captures=short.captures[1:]))
    old = complete_results("old", scorer(40.0), suite_name="mini")
    protocols = dict(old.protocols)
    protocols["hwp-v0"] = {**protocols.pop("hwp-v1"), "name": "hwp-v0"}
    return [plain, first, second, short_entry, make_entry(replace(old, protocols=protocols))]


def test_each_protocol_has_a_table_and_incomplete_rows_no_rank(entries) -> None:
    now, old = board_tables(entries)
    assert now.caption == "Suite mini, protocol hwp-v1"
    assert [row[:3] for row in now.rows] == [
        ("Mine", 1, "1"),
        ("Plain", 2, "2"),
        ("Short", None, None),
    ]
    assert [now.rank(row, 3) for row in range(3)] == [0, 1, None]
    assert now.notes[0].startswith("Mine wins with PSNR ")
    assert "+1.00 dB against Plain" in now.notes[0]
    assert "have no rank" in now.notes[1]
    assert old.caption == "Suite mini, protocol hwp-v0"
    assert [row[0] for row in old.rows] == ["Old"]
    assert "rows of hwp-v1 stand in another table" in old.notes[-1]


def test_a_run_that_was_submitted_twice_is_ranked_once(entries) -> None:
    _, _, second, *_ = entries
    plain = make_entry(complete_results("other", scorer(25.0), suite_name="mini"))
    twin = make_entry(plain.results, Submission(by="B"))
    (table,) = board_tables([plain, second, twin])
    assert [row[1] for row in table.rows] == [1, 2, None]
    assert re.search(
        r"No rank for a second entry of the same run: other-mini-\S+\.$", table.notes[0]
    )
    # The one that was checked stays, whatever its name.
    for one, other in ((plain, twin), (twin, plain)):
        checked = replace(one, checks=(check_of(one),))
        (table,) = board_tables([checked, second, other])
        ranks = {row[-1]: row[1] for row in table.rows}
        assert (ranks[one.name], ranks[other.name]) == (2, None)


def test_a_row_of_another_seed_takes_no_rank_from_others() -> None:
    found = []
    for name, level, seeds in (
        ("odd", 30.0, (7,)),
        ("mine", 26.0, (0, 1)),
        ("plain", 25.0, (0, 7)),
        ("other", 24.0, (0,)),
    ):
        for seed in seeds:
            results = complete_results(name, scorer(level), suite_name="mini")
            found.append(make_entry(replace(results, seed=seed)))
    (table,) = board_tables(found)
    assert {row[0]: row[1] for row in table.rows} == {
        "Mine": 1,
        "Plain": 2,
        "Other": 3,
        "Odd": None,
    }
    assert table.notes[0].startswith("Mine wins with PSNR ")
    assert "without the seed 0, which most rows have" in table.notes[0]
    assert table.notes[0].endswith(f"every other row: {found[0].name}.")


def test_a_row_that_shares_a_seed_with_everyone_is_ranked() -> None:
    found = []
    for name, level, seeds in (("bridge", 30.0, (1, 2)), ("b", 26.0, (0, 1)), ("c", 25.0, (0, 2))):
        for seed in seeds:
            results = complete_results(name, scorer(level), suite_name="mini")
            found.append(make_entry(replace(results, seed=seed)))
    (table,) = board_tables(found)
    assert [row[1] for row in table.rows] == [1, 2, 3]
    assert "No rank" not in table.notes[0]


def test_the_command_shows_levels_and_badges_in_80_columns(
    entries, tmp_path: Path, capsys, monkeypatch
) -> None:
    monkeypatch.delenv("COLUMNS", raising=False)
    folder = tmp_path / "entries"
    for entry in entries[:3]:
        write_entry(folder, entry)
    write_check(folder, check_of(entries[0]))
    words = ["leaderboard", "show", "--entries", str(folder)]
    # The name of a baseline is not anybody's.
    assert main(words) == 0
    assert "carries the name of plain, a method that ships" in capsys.readouterr().err
    assert main(["leaderboard", "check", "--entries", str(folder)]) == 2
    register = ["leaderboard", "register", entries[0].name, "--entries", str(folder)]
    assert main(register) == 0
    assert main(["leaderboard", "check", "--entries", str(folder)]) == 0
    capsys.readouterr()
    assert main(words) == 0
    out = capsys.readouterr().out
    assert max(map(len, out.splitlines())) <= 80
    for text in ("self-reported", "not tried", "rescored", "scores hold", "Mine wins with PSNR"):
        assert text in out
    assert main([*words, "--suite", "mini", "--json"]) == 0
    (table,) = json.loads(capsys.readouterr().out)
    assert [row["Level"] for row in table["rows"]] == ["self-reported", "rescored"]
    assert main([*words, "--suite", "full"]) == 2


def test_the_site_has_the_ranks_of_the_terminal_and_one_verdict_a_suite(entries) -> None:
    page = page_of(entries)
    assert re.findall(r'data-key="rank" data-number="(\d*)">(.*?)</td>', page) == [
        ("1", "1"),
        ("2", "2"),
        ("", "–"),
    ]
    (sentence,) = re.findall(r'class="note verdict">(.*?)</p>', page)
    assert sentence.startswith("mini: Mine wins with PSNR ")


def test_the_site_says_which_ranks_the_data_allow_and_escapes_titles() -> None:
    found = []
    for name, sign in (("left", 1), ("right", -1)):
        # Each is better on every other capture, by the same amount but for a hundredth.
        results = complete_results(
            name, lambda c, f, sign=sign: 25 + sign * ((-1) ** c + 0.01), suite_name="mini"
        )
        method = replace(results.method, title=f"<b>{name}</b>")
        found.append(make_entry(replace(results, method=method)))
    page = page_of(found)
    ranks = re.findall(r'data-key="rank" data-number="(\d*)">(.*?)</td>', page)
    assert sorted(ranks) == [("1", "1 (1 to 2)"), ("2", "2 (1 to 2)")]
    assert "<b>left" not in page
    assert "&lt;b&gt;left" in page.partition('note verdict">')[2]


def test_seeds_of_a_method_are_one_row_of_the_site_with_a_report_each() -> None:
    found = []
    for name, level, seeds in (("mine", 26.0, (0, 1)), ("plain", 25.0, (0,))):
        for seed in seeds:
            results = complete_results(name, scorer(level), suite_name="mini")
            found.append(make_entry(replace(results, seed=seed)))
    page = page_of(found)
    ranks = re.findall(r'data-key="rank" data-number="(\d*)">(.*?)</td>', page)
    assert sorted(ranks) == [("1", "1"), ("2", "2")]
    for entry in found:
        assert page.count(f'<a href="reports/{entry.name}/index.html" aria-label="Report of') == 1
    assert len(re.findall(r'class="note verdict">', page)) == 1
