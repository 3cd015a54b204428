"""The leaderboard's page. Oracles: a JavaScript engine, and headless Chromium where it is."""

from __future__ import annotations

import json
from collections.abc import Iterator
from dataclasses import replace
from typing import Any

import pytest
from browser import DESK, PHONE, least_contrast, open_page, overflow, show
from made_entries import page_of

from hwp_bench.leaderboard.board_rows import BoardRow
from hwp_bench.leaderboard.entries import Entry, entry_name, make_entry
from hwp_bench.leaderboard.page_row import budget_text, make_row
from hwp_bench.leaderboard.records import Submission
from hwp_bench.leaderboard.site import build_site, script
from hwp_bench.metrics import PROTOCOLS
from hwp_bench.results import FrameResult

EVIL = '"><img src=x onerror=alert(1)>'


@pytest.fixture
def entries(make_results) -> list[Entry]:
    """Three methods; the best overall is not the best on motion blur; one on another suite."""
    protocols = json.loads(json.dumps({p.name: p.as_dict() for p in PROTOCOLS}))
    found = []
    rows = (
        (EVIL, "smoke", None, {"illumination": 30.0, "motion_blur": 10.0}),
        ("Beta", "smoke", 60, {"illumination": 15.0, "motion_blur": 21.0}),
        ("Gamma", "mini", None, {"illumination": 18.0}),
    )
    for number, (title, suite, seconds, scores) in enumerate(rows):
        result = make_results(f"m{number}")
        captures = [
            replace(
                result.captures[0],
                id=f"capture-{name}",
                device=title,
                perturbations=[name],
                frames=[
                    FrameResult(18, {"psnr": psnr, "ssim": 0.5, "oriented_distance": 0.01}, None)
                ],
            )
            for name, psnr in scores.items()
        ]
        result = replace(
            result,
            method=replace(result.method, title=title),
            suite=suite,
            protocols=protocols,
            budget={"seconds": seconds, "steps": None},
            captures=captures,
        )
        found.append(Entry(entry_name(result), result))
    return found


def test_rows_hold_the_means_of_every_scope(entries) -> None:
    row = make_row(BoardRow((entries[0],)))
    assert row.scores["macro"]["psnr"] == pytest.approx(20.0)
    assert row.scores["motion_blur"]["psnr"] == pytest.approx(10.0)
    assert row.scores["interacting"]["psnr"] is None
    assert row.fit == pytest.approx(2.0)
    assert budget_text({"seconds": 60.0, "steps": 500}) == "60 s, 500 steps"
    assert budget_text({"seconds": None, "steps": None}) == "no limit"


def test_names_are_escaped_and_published_rows_stand_apart(entries) -> None:
    page = page_of(entries)
    assert EVIL not in page
    assert "&lt;img src=x" in page
    measured, published = page.split('id="published"')
    assert "InterGaussianHand" in published
    assert "InterGaussianHand" not in measured
    assert "Published, on other data" in measured
    # Without script every row is there, best macro mean of each suite first.
    assert measured.index("Beta") > measured.index("&lt;img")
    assert "There is no entry yet" in page_of([])


@pytest.fixture
def board() -> Any:
    engine = pytest.importorskip("quickjs").Context()
    engine.eval(str(script()))
    return engine


def test_sorting_puts_what_was_not_measured_last(board) -> None:
    def order(cells: list, descending: bool) -> list[int]:
        spelled = f"JSON.stringify(Board.order({json.dumps(cells)}, {json.dumps(descending)}))"
        return json.loads(board.eval(spelled))

    assert order([3, 1, None, 2, 10], False) == [1, 3, 0, 4, 2]
    assert order([3, 1, None, 2, 10], True) == [4, 0, 3, 1, 2]
    assert order(["b", "a", "b"], True) == [0, 2, 1]
    assert order([1, 1, 1], True) == [0, 1, 2]


def test_filters_and_addresses(board) -> None:
    shown = "Board.shown({suite: 'mini', budget: '60 s'}, {suite: %s, budget: %s})"
    for suite, budget, wanted in (("", "", True), ("mini", "60 s", True), ("smoke", "", False)):
        assert board.eval(shown % (json.dumps(suite), json.dumps(budget))) is wanted
    assert board.eval("Board.scope({scope: 'macro', severity: ''})") == "macro"
    assert board.eval("Board.scope({scope: 'motion_blur', severity: '4'})") == "motion_blur@4"
    state = {"suite": "mini", "budget": "60 s, 5 steps", "sort": "psnr", "down": ""}
    spelled = board.eval(f"Board.write({json.dumps(state)})")
    assert spelled == "suite=mini&budget=60%20s%2C%205%20steps&sort=psnr"
    back = json.loads(board.eval(f"JSON.stringify(Board.read('#{spelled}&x=%E0%A4%A'))"))
    assert back == {"suite": "mini", "budget": "60 s, 5 steps", "sort": "psnr"}


@pytest.fixture
def browser(entries, tmp_path) -> Iterator[Any]:
    """Chromium at the site, driven by the keyboard and the mouse."""
    with open_page(build_site(tmp_path / "site", entries), tmp_path / "profile") as driver:
        yield driver


def visible(browser: Any) -> list[str]:
    script = (
        "return [...document.querySelectorAll('#measured tr[data-suite]')]"
        ".filter(row => !row.hidden).map(row => row.cells[0].textContent.trim())"
    )
    return browser.execute_script(script)


def open_anew(browser: Any, address: str) -> None:
    """Open an address as if it were passed on, and wait for the page's script.

    The driver's `get` may return with the table there and its script still to run, and the order
    of the rows does not tell: the script's last act is to count them.
    """
    from selenium.webdriver.support.ui import WebDriverWait

    browser.get("about:blank")
    browser.get(address)
    counted = "return Boolean(document.getElementById('status')?.textContent)"
    WebDriverWait(browser, 20).until(lambda driver: driver.execute_script(counted))


@pytest.mark.slow
def test_the_board_in_chromium(browser) -> None:
    from selenium.webdriver.common.by import By
    from selenium.webdriver.common.keys import Keys
    from selenium.webdriver.support.ui import Select

    assert visible(browser) == [EVIL, "Beta", "Gamma"]
    # By keyboard; Enter turns the order round, within each suite. Macro means: 20 and 18; 18.
    psnr = browser.find_element(By.CSS_SELECTOR, "button[data-sort=psnr]")
    psnr.send_keys(Keys.ENTER)
    assert visible(browser) == ["Beta", EVIL, "Gamma"]
    head = browser.find_element(By.CSS_SELECTOR, "th[aria-sort=ascending]")
    assert "PSNR" in head.text
    psnr.send_keys(Keys.SPACE)
    Select(browser.find_element(By.ID, "scope")).select_by_value("motion_blur")
    assert visible(browser) == ["Beta", EVIL, "Gamma"]
    cells = browser.find_elements(By.CSS_SELECTOR, '#measured [data-key="psnr"]')
    assert [cell.text for cell in cells] == ["21.00", "10.00", "–"]
    # Captures of the toy results are of no scene, so that none has a severity.
    assert [one.text for one in Select(browser.find_element(By.ID, "severity")).options] == ["all"]
    Select(browser.find_element(By.ID, "suite")).select_by_value("smoke")
    assert visible(browser) == ["Beta", EVIL]
    Select(browser.find_element(By.ID, "budget")).select_by_value("60 s")
    assert visible(browser) == ["Beta"]
    assert browser.find_element(By.ID, "status").text == "1 of 3 rows"
    # The address holds the choice, so that it can be passed on.
    # The page itself is asked: the browser around it learns of a new address a little later.
    address = browser.execute_script("return location.href")
    assert address.endswith("#suite=smoke&scope=motion_blur&budget=60%20s&sort=psnr&down=1")
    open_anew(browser, address)
    assert visible(browser) == ["Beta"]
    # A row is opened by keyboard as well: the page of its method, and from there its report.
    browser.find_element(By.LINK_TEXT, "Beta").send_keys(Keys.ENTER)
    assert "/methods/1-m1.html" in browser.current_url
    assert "60 s" in browser.find_element(By.CSS_SELECTOR, "table.made").text
    browser.find_element(By.LINK_TEXT, "Report of seed 0").send_keys(Keys.ENTER)
    assert "/reports/m1-smoke-60s" in browser.current_url
    assert "HWP bench: Beta" in browser.title


@pytest.mark.slow
def test_everything_is_reached_with_the_tab_key(browser) -> None:
    from selenium.webdriver.common.by import By
    from selenium.webdriver.common.keys import Keys

    reached = []
    for _ in range(24):
        browser.switch_to.active_element.send_keys(Keys.TAB)
        active = browser.switch_to.active_element
        if active.tag_name == "body":
            break
        reached.append(
            active.get_attribute("data-sort") or active.get_attribute("id") or active.text
        )
    wanted = ["suite", "scope", "budget", "method", "psnr", "Beta", "Gamma"]
    assert [name for name in wanted if name not in reached] == []
    assert browser.find_elements(By.CSS_SELECTOR, "img") == []


@pytest.mark.slow
def test_a_hostile_address_changes_nothing(browser) -> None:
    address = browser.current_url.split("#")[0]
    for state in ("suite=<img src=x>", "sort=__proto__&down=1", "scope=constructor", "budget=%E0"):
        open_anew(browser, f"{address}#{state}")
        assert visible(browser) == [EVIL, "Beta", "Gamma"]
    assert browser.execute_script("return document.images.length") == 0


@pytest.mark.slow
def test_it_is_legible_on_a_phone_in_the_dark_and_on_paper(browser) -> None:
    """WCAG AA asks for a contrast of 4.5; a first column of 60 px holds more than a letter."""
    for width, dark, media in (
        (DESK, False, "screen"),
        (PHONE, True, "screen"),
        (PHONE, False, "print"),
    ):
        show(browser, width, dark=dark, media=media)
        assert least_contrast(browser) >= 4.5
        narrowest = "return Math.min(...[...document.querySelectorAll('td:first-child')]"
        assert browser.execute_script(f"{narrowest}.map(cell => cell.clientWidth))") >= 60
        if media == "screen":
            assert overflow(browser) <= 0
    # On paper nothing is there to be pressed.
    assert not browser.find_element("id", "controls").is_displayed()


def test_the_board_shows_the_current_revision_of_one_protocol(entries) -> None:
    first = entries[1]
    again = Submission(revises=first.name, reason="the device was wrong")
    second = make_entry(first.results, again)
    old = replace(entries[2].results, protocols={"hwp-v0": {}})
    rows = [*entries, second, make_entry(replace(old, method=replace(old.method, title="Omega")))]
    page = page_of(rows)
    assert second.name in page
    assert f"reports/{first.name}/" not in page
    assert "Omega" not in page
    assert page.count('<td data-key="level"') == 3
    row = make_row(BoardRow((second,)), older=[first])
    assert (row.level, row.badge) == ("self-reported", "not tried")
    assert [(old.name, old.why) for old in row.older] == [
        (first.name, "replaced: the device was wrong")
    ]
