"""Rows of several seeds. Oracle: means of constructed scores, and constructed checks."""

from __future__ import annotations

import json
import re
from dataclasses import replace
from pathlib import Path

import pytest
from browser import open_page
from made_entries import check_of, complete_results, page_of

from hwp_bench.capture.splits import split_for
from hwp_bench.cli.main import main
from hwp_bench.leaderboard import suite_data
from hwp_bench.leaderboard.board import (
    BoardRow,
    at_severity,
    board_rows,
    board_tables,
    method_rows,
    severities_of,
)
from hwp_bench.leaderboard.entries import Submission, make_entry, write_check, write_entry
from hwp_bench.leaderboard.site import build_site
from hwp_bench.leaderboard.suite_data import suite_severities
from hwp_bench.report.sources import mean_severity
from hwp_bench.results.schema import score_rows
from hwp_bench.sim.produce.capture import SuiteItem, render_capture
from hwp_bench.sim.scene_files import load_scene


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


def test_a_row_has_the_metrics_of_all_its_seeds() -> None:
    """A machine without a package or weights has fewer; the order of the seeds does not matter."""
    first, second = results("mine", 24.0, 0), results("mine", 24.0, 1)
    for seed in (first, second):
        more = [
            replace(c, frames=[replace(f, scores={**f.scores, "flip": 0.1}) for f in c.frames])
            for c in seed.captures
        ]
        other = second if seed is first else first
        (row,) = board_rows(map(make_entry, (replace(seed, captures=more), other)))
        assert "flip" not in row.scores
        assert row.scores["psnr"] == pytest.approx(24.5)


def test_another_budget_is_another_row() -> None:
    first = results("mine", 24.0, 0)
    longer = replace(results("mine", 24.0, 1), budget={"seconds": 99.0})
    assert [row.seeds for row in board_rows(map(make_entry, (first, longer)))] == [(0,), (1,)]


def test_a_large_budget_is_written_out() -> None:
    made = make_entry(replace(results("mine", 24.0, 0), budget={"steps": 1_000_001}))
    (row,) = board_rows([made])
    assert row.budget == "1,000,001 steps"
    assert "-1000001steps-" in made.name


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
            own = next(m for m in (own, *strange) if m.entries == (checked,))
            assert not own.older
        else:
            assert own.older == (other,)
        assert own.entries == (checked,)
        # What was checked as far, and is of the same submitter, does take the place.
        revised = replace(other, checks=(check_of(other),))
        taken = any(method.entries == (revised,) for method in method_rows([checked, revised]))
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
    assert method.entries == (runs[1],)
    assert method.older == (runs[0], runs[2])
    # A run that was checked stays ahead of newer ones that were not.
    checked = replace(runs[2], checks=(check_of(runs[2]),))
    (method,) = method_rows([*runs[:2], checked])
    assert method.entries == (checked,)


def test_seconds_are_means_over_seeds_or_unknown() -> None:
    def timed(seed: int, seconds: float | None):
        made = results("mine", 24.0, seed)
        captures = tuple(replace(one, fit_seconds=seconds) for one in made.captures)
        return make_entry(replace(made, captures=captures))

    (row,) = board_rows([timed(0, 10.0), timed(1, 20.0)])
    assert row.fit_seconds == pytest.approx(15.0)
    (row,) = board_rows([timed(0, None)])
    assert row.fit_seconds is None


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
    register = ["dev", "leaderboard", "register", entries[0].name, "--entries", str(folder)]
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
    (sentence,) = re.findall(r'class="verdict">(.*?)</p>', page)
    assert sentence.startswith("Mine wins with PSNR ")
    assert "+1.00 dB against Plain" in sentence


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
    assert "&lt;b&gt;left" in page.partition('class="verdict">')[2]


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
    assert len(re.findall(r'class="verdict">', page)) == 1


@pytest.fixture
def entry():
    """An entry on mini whose scores are 20, 21, ... dB by capture."""
    return make_entry(complete_results("mine", lambda c, f: 20.0 + c, suite_name="mini"))


@pytest.mark.slow
def test_scenes_say_what_captures_say(tmp_path, monkeypatch) -> None:
    """Oracle: the severities that a rendered capture holds."""
    scene = load_scene("capture0")
    item = SuiteItem(scene, 20, 32)
    monkeypatch.setattr(suite_data, "suite", lambda name: (item,))
    capture = render_capture(
        scene, tmp_path / "c", frame_count=20, size=32, workers=1, free_view=False
    )
    test = split_for(scene.id, 20).test.tolist()
    means = mean_severity(capture.info, test, perturbed_only=True)
    assert len(means) == 2
    assert suite_severities.__wrapped__("any") == {
        scene.id: {name: round(value) for name, value in means.items()}
    }


def test_a_severity_keeps_the_perturbations_that_have_it(entry) -> None:
    """Of mini, captures 0, 1, 5 and 6 have two perturbations of severity 4, 4 one of 2 and 4."""
    captures = score_rows(entry.results)
    severities = suite_severities("mini")
    found = {one.id: one.perturbations for one in at_severity(captures, severities, 2)}
    assert found == {"capture4": ("hand_object_interaction",)}
    strong = {one.id: one.perturbations for one in at_severity(captures, severities, 4)}
    assert strong["capture4"] == ("motion_blur",)
    assert at_severity(captures, severities, 5) == []
    kept = [
        (capture.id, name)
        for level in range(1, 6)
        for capture in at_severity(captures, severities, level)
        for name in capture.perturbations
    ]
    every = [(capture.id, name) for capture in captures for name in capture.perturbations]
    assert sorted(kept) == sorted(every)


def test_rows_hold_the_means_of_every_severity(entry) -> None:
    row = BoardRow((entry,))
    assert severities_of([row]) == [2, 3, 4]
    scores = {scope: values["psnr"] for scope, values in row.scopes.items()}
    # Capture 4 alone has objects of severity 2, and capture 3 alone of severity 3.
    assert scores["hand_object_interaction@2"] == scores["macro@2"] == pytest.approx(24.0)
    assert scores["hand_object_interaction@3"] == pytest.approx(23.0)
    assert "motion_blur@2" not in scores
    # Illumination is of severity 4 in all of its captures, 2 and 7.
    assert scores["illumination@4"] == scores["illumination"] == pytest.approx(24.5)


@pytest.mark.slow
def test_a_severity_is_chosen_in_chromium(entry, tmp_path) -> None:
    from selenium.webdriver.common.by import By
    from selenium.webdriver.support.ui import Select

    site = build_site(tmp_path / "site", [entry])
    with open_page(site, tmp_path / "profile") as driver:
        score = driver.find_element(By.CSS_SELECTOR, '#measured [data-key="psnr"]')
        before = score.text
        Select(driver.find_element(By.ID, "severity")).select_by_value("2")
        assert (score.text, before != "24.00") == ("24.00", True)
        assert "severity=2" in driver.current_url
        Select(driver.find_element(By.ID, "scope")).select_by_value("motion_blur")
        assert score.text == "–"
