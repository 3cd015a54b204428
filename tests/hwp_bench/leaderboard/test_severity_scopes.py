"""Scores by severity. Oracles: the captures' own severities, and means by hand."""

from __future__ import annotations

import pytest
from browser import open_page
from made_entries import complete_results

from hwp_bench.capture.splits import split_for
from hwp_bench.leaderboard import severity_scopes
from hwp_bench.leaderboard.board_rows import BoardRow
from hwp_bench.leaderboard.entries import make_entry
from hwp_bench.leaderboard.page_row import make_row, severities_of
from hwp_bench.leaderboard.severity_scopes import at_severity, suite_severities
from hwp_bench.leaderboard.site import build_site
from hwp_bench.report.sources import mean_severity
from hwp_bench.results.schema import score_rows
from hwp_bench.sim.produce.capture import render_capture
from hwp_bench.sim.produce.suites import SuiteItem
from hwp_bench.sim.scene_files import load_scene


@pytest.fixture
def entry():
    """An entry on mini whose scores are 20, 21, ... dB by capture."""
    return make_entry(complete_results("mine", lambda c, f: 20.0 + c, suite_name="mini"))


@pytest.mark.slow
def test_scenes_say_what_captures_say(tmp_path, monkeypatch) -> None:
    """Oracle: the severities that a rendered capture holds."""
    scene = load_scene("capture0")
    item = SuiteItem(scene, 20, 32)
    monkeypatch.setattr(severity_scopes, "suite", lambda name: (item,))
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
    row = make_row(BoardRow((entry,)))
    assert severities_of([row]) == [2, 3, 4]
    scores = {scope: values["psnr"] for scope, values in row.scores.items()}
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
