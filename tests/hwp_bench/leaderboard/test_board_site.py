"""The leaderboard's page. Oracles: a JavaScript engine, and headless Chromium where it is."""

from __future__ import annotations

import json
import re
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from browser import DESK, PHONE, least_contrast, open_page, overflow, show
from made_entries import complete_results, page_of
from made_results import made_results
from small_captures import CaptureMaker, results_example

from hwp_bench.base.files import sha256_json
from hwp_bench.base.images import write_image
from hwp_bench.capture import Capture
from hwp_bench.capture.schema import frame_name
from hwp_bench.leaderboard.board import BoardRow, board_rows
from hwp_bench.leaderboard.entries import Entry, Submission, entry_name, make_entry
from hwp_bench.leaderboard.site import (
    build_site,
    curve_plot,
    method_pages,
    script,
    write_method_pages,
)
from hwp_bench.methods.manifest import shipped_methods
from hwp_bench.metrics import PROTOCOLS
from hwp_bench.report.sources import ResultsSource
from hwp_bench.results import FrameResult, TrainingData
from hwp_bench.results.schema import budget_text

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


def test_suites_stand_apart_with_the_one_that_nothing_was_tuned_on_first() -> None:
    made = [
        make_entry(
            replace(
                complete_results(name, 20.0, suite_name=suite),
                budget={"seconds": 16.0, "steps": 100_000},
            )
        )
        for suite in ("mini", "wild-test")
        for name in ("mine", "plain")
    ]
    page = page_of(made)
    assert re.findall(r'<h2 id="h-\S+">(.*?)</h2>', page)[:2] == [
        "wild-test: simulated hands as various as the world, on which nothing was tuned",
        "mini: eight of the paper&#39;s captures, simulated and short; WildGHand&#39;s design set",
    ]
    assert page.count("16 s</td>") == 4


def test_the_training_data_stand_in_the_row(entries) -> None:
    method = entries[0].results.method
    kinds = TrainingData(public=["HanCo"], private=["scans"])
    learnt = replace(entries[0].results, method=replace(method, training=kinds))
    page = page_of([Entry("learnt", learnt), *entries[1:]])
    assert 'data-training="public private"' in page
    assert '<td data-key="training">public data sets, private data</td>' in page
    options = re.search(r'<select id="training">(.*?)</select>', page)
    assert options is not None
    assert re.findall(r'value="(\w*)"', options[1]) == ["", "none", "public", "private"]


def test_rows_hold_the_means_of_every_scope(entries) -> None:
    row = BoardRow((entries[0],))
    assert row.scopes["macro"]["psnr"] == pytest.approx(20.0)
    assert row.scopes["motion_blur"]["psnr"] == pytest.approx(10.0)
    assert row.scopes["interacting"]["psnr"] is None
    assert row.fit_seconds == pytest.approx(2.0)
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
    # Rows that lack a part of their suite come last, whichever way.
    lacking = "JSON.stringify(Board.order([3, 1, 2], {}, [1, 0, 0]))"
    assert json.loads(board.eval(lacking.format("true"))) == [2, 1, 0]
    assert json.loads(board.eval(lacking.format("false"))) == [1, 2, 0]


def test_filters_and_addresses(board) -> None:
    row = "{suite: 'mini', budget: '60 s', training: ['public', 'private']}"
    for kind, wanted in (("", True), ("private", True), ("none", False), ("pub", False)):
        assert board.eval(f"Board.shown({row}, {{training: '{kind}'}})") is wanted
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
    Select(browser.find_element(By.ID, "training")).select_by_value("none")
    assert visible(browser) == ["Beta", EVIL]
    Select(browser.find_element(By.ID, "training")).select_by_value("")
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
    for _ in range(60):
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
    assert page.count('<td data-key="badge"') == 3
    row = BoardRow((second,), older=(first,))
    assert (row.level, row.badge) == ("self-reported", "not tried")
    assert [(old.name, row.why_older(old)) for old in row.older] == [
        (first.name, "replaced: the device was wrong")
    ]


EVIL_ID = "</script><img src=x onerror=alert(1)>"
SCORES = {16: 30.0, 17: 10.0, 18: 20.0}


def entry_of(
    folder: Path,
    capture: Capture,
    title: str,
    *,
    gain: float,
    suite: str = "smoke",
    seed: int = 0,
) -> ResultsSource:
    """An entry that draws the truth times a gain; with 1 it is the truth."""
    example = results_example(f"m{gain:g}".replace(".", "-"))
    frames = [
        FrameResult(frame, {"psnr": gain * psnr, "ssim": 0.5, "oriented_distance": 0.01}, None)
        for frame, psnr in SCORES.items()
    ]
    digest = sha256_json(capture.info.to_json())
    results = replace(
        example,
        method=replace(example.method, title=title),
        suite=suite,
        seed=seed,
        protocols=json.loads(json.dumps({p.name: p.as_dict() for p in PROTOCOLS})),
        captures=[replace(example.captures[0], id=capture.info.id, digest=digest, frames=frames)],
    )
    place = folder / "captures" / capture.info.id / "predictions"
    place.mkdir(parents=True)
    for frame in SCORES:
        write_image(place / frame_name(frame), (gain * capture.frame(frame)).astype(np.uint8))
    return ResultsSource(results, folder)


@pytest.fixture
def built(make_capture: CaptureMaker, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A site of two methods on one capture: the truth, and half of it under a hostile title."""
    capture = make_capture(frames=20, size=48)
    sources = [
        entry_of(tmp_path / "truth", capture, "Truth as an entry", gain=1.0),
        entry_of(tmp_path / "half", capture, EVIL_ID, gain=0.5),
    ]
    digest = sha256_json(capture.info.to_json())
    # Captures are found in the toolkit's cache; this one lies elsewhere.
    monkeypatch.setattr(
        "hwp_bench.leaderboard.site.open_captures_of", lambda results: {digest: capture}
    )
    entries = [make_entry(one.results) for one in sources]
    return build_site(tmp_path / "site", entries, sources)


def gallery(page: Path) -> list[dict[str, Any]]:
    text = (page.parent / "gallery.js").read_text("utf-8")
    value: list[dict[str, Any]] = json.loads(text.removeprefix("var GALLERY = ").rstrip(";\n"))
    return value


def picture(page: Path, address: str) -> np.ndarray:
    image = cv2.imread(str(page.parent / address))
    assert image is not None
    return image.astype(int)


def test_the_truth_as_an_entry_looks_like_the_truth(built: Path) -> None:
    scenes = gallery(built)
    assert [scene["frame"] for scene in scenes] == list(SCORES)
    for scene in scenes:
        best, other = scene["shots"]
        assert best["title"] == "Truth as an entry"
        truth = picture(built, scene["truth"])
        assert truth.max() > 50
        np.testing.assert_array_equal(picture(built, best["picture"]), truth)
        assert abs(picture(built, other["picture"]) - truth).max() > 20
        # The error map of the truth is its coldest colour everywhere on the hand.
        assert picture(built, best["error"]).max() < 20
        assert picture(built, other["error"]).max() > 100


def test_each_row_is_shown_once_and_each_suite_has_its_own_captures(
    make_capture: CaptureMaker, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    small = make_capture("capture1", frames=20, size=48, folder=tmp_path / "small")
    large = make_capture("capture1", frames=20, size=64, folder=tmp_path / "large-capture")
    captures = {sha256_json(one.info.to_json()): one for one in (small, large)}
    monkeypatch.setattr("hwp_bench.leaderboard.site.open_captures_of", lambda results: captures)
    # One capture is a whole suite here.
    monkeypatch.setattr("hwp_bench.leaderboard.board.find_missing", lambda results: [])
    sources = [
        entry_of(tmp_path / "better", small, "Mine", gain=0.9, seed=1),
        entry_of(tmp_path / "first", small, "Mine", gain=0.9, seed=0),
        entry_of(tmp_path / "truth", small, "Theirs", gain=1.0),
        entry_of(tmp_path / "large", large, "Mine", gain=0.9, suite="mini"),
    ]
    page = build_site(tmp_path / "site", [make_entry(one.results) for one in sources], sources)
    scenes = gallery(page)
    names = [f"{small.info.id} of smoke", f"{small.info.id} of mini"]
    assert [scene["capture"] for scene in scenes] == [name for name in names for _ in SCORES]
    # The best of the suite comes first, in every frame; one seed stands for a method.
    for scene, titles in zip(scenes, 3 * [["Theirs", "Mine"]] + 3 * [["Mine"]], strict=True):
        assert [shot["title"] for shot in scene["shots"]] == titles
    assert scenes[0]["shots"][1]["entry"] == make_entry(sources[1].results).name


def test_without_predictions_there_is_no_viewer(
    built: Path, make_capture: CaptureMaker, tmp_path: Path
) -> None:
    capture = make_capture("other", frames=20, size=48)
    results = entry_of(tmp_path / "other-truth", capture, "Truth", gain=1.0).results
    page = build_site(tmp_path / "bare", [make_entry(results)])
    assert 'id="viewer"' not in page.read_text("utf-8")
    assert not (page.parent / "gallery.js").exists()
    assert 'id="viewer"' in built.read_text("utf-8")


@pytest.fixture
def driver(built: Path, tmp_path: Path) -> Iterator[Any]:
    with open_page(built, tmp_path / "profile") as found:
        yield found


def share_shown(driver: Any) -> float:
    """The share of the left picture that is not cut away."""
    clip = driver.execute_script(
        "return document.getElementById('viewer-left-picture').style.clipPath"
    )
    return 1.0 - float(clip.split("%")[0].split()[-1]) / 100.0


def touch(driver: Any, x: float, y: float) -> None:
    point = {"x": x, "y": y}
    for kind, points in (("touchStart", [point]), ("touchEnd", [])):
        event = {"type": kind, "touchPoints": points}
        driver.execute_cdp_cmd("Input.dispatchTouchEvent", event)


@pytest.mark.slow
def test_the_divider_moves_by_keyboard_mouse_and_touch(driver: Any) -> None:
    from selenium.webdriver.common.action_chains import ActionChains
    from selenium.webdriver.common.keys import Keys

    divider = driver.find_element("id", "viewer-divider")
    assert share_shown(driver) == pytest.approx(0.5)
    for _ in range(5):
        divider.send_keys(Keys.ARROW_RIGHT)
    assert share_shown(driver) == pytest.approx(0.55)
    width = divider.size["width"]
    ActionChains(driver).move_to_element_with_offset(
        divider, int(-0.3 * width), 0
    ).click().perform()
    assert share_shown(driver) == pytest.approx(0.2, abs=0.06)
    show(driver, PHONE)
    driver.execute_cdp_cmd("Emulation.setTouchEmulationEnabled", {"enabled": True})
    place = driver.execute_script(
        "const e = document.getElementById('viewer-divider'); e.scrollIntoView();"
        "const b = e.getBoundingClientRect(); return [b.left, b.top, b.width, b.height]"
    )
    touch(driver, place[0] + 0.8 * place[2], place[1] + 0.5 * place[3])
    assert share_shown(driver) == pytest.approx(0.8, abs=0.06)


@pytest.mark.slow
def test_choices_change_the_pictures_and_hostile_titles_are_text(driver: Any, built: Path) -> None:
    from selenium.webdriver.support.ui import Select

    right = Select(driver.find_element("id", "viewer-right"))
    assert [option.text for option in right.options] == ["Truth", "Truth as an entry", EVIL_ID]
    assert driver.find_elements("css selector", "img[src=x]") == []
    before = driver.find_element("id", "viewer-right-picture").get_attribute("src")
    right.select_by_visible_text(EVIL_ID)
    after = driver.find_element("id", "viewer-right-picture").get_attribute("src")
    assert before != after
    assert driver.find_element("id", "viewer-right-caption").text.startswith(EVIL_ID)
    Select(driver.find_element("id", "viewer-frame")).select_by_value("17")
    truth = next(scene["truth"] for scene in gallery(built) if scene["frame"] == 17)
    assert driver.find_element("id", "viewer-truth").get_attribute("src").endswith(truth)
    Select(driver.find_element("id", "viewer-left")).select_by_value("truth")
    assert not driver.find_element("id", "viewer-left-error-figure").is_displayed()
    assert driver.find_element("id", "viewer-right-error-figure").is_displayed()


@pytest.mark.slow
def test_the_picture_is_on_the_first_screen_at_any_width_and_in_the_dark(driver: Any) -> None:
    for width in (DESK, 1280, PHONE, 390):
        for dark in (False, True):
            show(driver, width, dark=dark)
            assert overflow(driver) == 0
            assert least_contrast(driver) >= 4.5
            driver.execute_script("window.scrollTo(0, 0)")
            top, height = driver.execute_script(
                "const b = document.getElementById('viewer-right-picture').getBoundingClientRect();"
                "return [b.top, b.height]"
            )
            assert height > 200
            assert top + height < 900


EVIL_NAME = "</td><script>alert(1)</script>"


def rows_of(*entries):
    return board_rows(entries)


def written(folder: Path, *entries) -> dict[str, str]:
    pages = method_pages(rows_of(*entries))
    write_method_pages(folder, pages)
    return {page.title: (folder / page.path).read_text("utf-8") for page in pages}


def results(name: str, **changes):
    return replace(complete_results(name, suite_name="smoke"), **changes)


def test_a_page_says_what_its_numbers_were_made_with(tmp_path: Path) -> None:
    first = make_entry(
        results("plain", budget={"seconds": 16.0, "steps": None}),
        Submission(by="A. Person", links={"code": "https://example.org/x"}),
    )
    second = make_entry(replace(first.results, seed=1), first.submission)
    page = written(tmp_path, first, second)["Plain"]
    captures = first.results.captures
    for text in (
        "16 s",
        "hwp-v1",
        first.digest,
        second.digest,
        first.results.method.digest,
        "A. Person",
        "https://example.org/x",
        captures[0].predictions_digest[:16],
        f"../reports/{first.name}/index.html",
        f"../reports/{second.name}/index.html",
        "self-reported",
    ):
        assert text in page, text


def test_a_method_that_ships_brings_its_own_page_without_links(tmp_path: Path) -> None:
    manifest = next(one for one in shipped_methods() if one.name == "trimmed")
    readme = (manifest.root / "README.md").read_text("utf-8")
    page = written(tmp_path, make_entry(results("trimmed")))["Trimmed"]
    assert manifest.description in page
    title = readme.splitlines()[0].lstrip("# ")
    assert f"<h3>{title}</h3>" in page
    own = page[page.index("Its own page") :]
    assert "<table>" in own
    assert "<a " not in own
    assert "<img" not in own


def test_names_are_escaped_and_no_name_is_a_path(tmp_path: Path) -> None:
    base = results("plain")
    evil = [
        make_entry(replace(base, method=replace(base.method, name=name, title=EVIL_NAME + name)))
        for name in ("../../up", "..", "a/b")
    ]
    pages = method_pages(rows_of(*evil))
    assert len({page.path for page in pages}) == 3
    write_method_pages(tmp_path, pages)
    assert len(list((tmp_path / "methods").iterdir())) == 3
    for file in (tmp_path / "methods").iterdir():
        assert "<script" not in file.read_text("utf-8")


def test_the_worst_frame_of_a_capture_stands_beside_its_best(built: Path) -> None:
    """Frames 16, 17 and 18 have 30, 10 and 20 dB."""
    pages = [file.read_text("utf-8") for file in (built.parent / "methods").glob("*.html")]
    assert len(pages) == 2
    for page in pages:
        figures = re.findall(
            r'<img src="../(\S+)" alt="truth">.*?<figcaption>(.*?)</fig', page, re.S
        )
        assert [text.split(", ", 1)[1].split(",")[0] for _, text in figures] == [
            "best: frame 16",
            "worst: frame 17",
        ]
        for address, text in figures:
            frame = int(text.split("frame ")[1].split(",")[0])
            assert (built.parent / address).name == f"{frame}-truth.jpg"
            assert picture(built, address).max() > 50
        assert "No pictures" not in page


def test_a_page_without_pictures_says_so_in_one_line(tmp_path: Path) -> None:
    entries = [make_entry(complete_results("plain", suite_name=name)) for name in ("mini", "smoke")]
    page = written(tmp_path, *entries)["Plain"]
    (line,) = re.findall(r"<p>(No pictures.*?)</p>", page)
    assert line.startswith("No pictures of mini, smoke: ")
    assert "<img" not in page


# Two captures have no interval; of more than four methods only the front has its bands.
@pytest.mark.parametrize(
    ("count", "suite", "bands"), [(2, "smoke", 0), (2, "mini", 2), (6, "mini", 1)]
)
def test_the_plot_of_a_table_names_every_method_and_the_front(
    count: int, suite: str, bands: int
) -> None:
    """A method that starts a decibel higher stays above the others at every time."""
    captures = complete_results(suite_name=suite).captures

    def run(number: int):
        curve = [(2.0**k, 15.0 + number + k) for k in range(4)]
        found = made_results(
            f"m{number}",
            lambda c, f, s: 20.0 + number,
            captures=len(captures),
            curve=curve,
            seconds=8.0,
        )
        kept = [
            replace(one, id=two.id, split_digest=two.split_digest, frames=two.frames)
            for one, two in zip(found.captures, captures, strict=True)
        ]
        return make_entry(replace(found, suite=suite, captures=kept))

    plot = curve_plot(board_rows([run(number) for number in range(count)]))
    assert plot is not None
    assert len(plot["methods"]) == count
    assert list(plot["front"]) == [f"M{count - 1}"]
    assert plot["figure"].count('class="band"') == bands
    assert plot["bands"].startswith("shaded bands" if bands else "no intervals")


def test_results_of_no_entry_are_named(tmp_path: Path, capsys) -> None:
    other = ResultsSource(results("other"), tmp_path / "runs")
    build_site(tmp_path / "site", [make_entry(results("plain"))], [other])
    assert f"left out: {tmp_path / 'runs'} is of no entry" in capsys.readouterr().err


def test_the_plot_says_that_machines_differ_and_which_fits_it_lacks() -> None:
    entries = []
    for number, processor in enumerate(("slow", "fast")):
        made = results(f"m{number}")
        captures = [replace(made.captures[0], curve=[]), *made.captures[1:]] if number else None
        made = replace(made, environment={"processor": processor, "cores": 2})
        entries.append(make_entry(replace(made, captures=captures or made.captures)))
    plot = curve_plot(board_rows(entries))
    assert plot is not None
    assert "Fits without a curve, left out: M1: 1." in plot["notes"]
    assert any("the seconds do not compare" in note for note in plot["notes"])


def test_a_page_names_the_machine_of_every_seed(tmp_path: Path) -> None:
    first = make_entry(results("plain"))
    there = {**first.results.environment, "processor": "Another CPU", "code": "f" * 64}
    second = make_entry(replace(first.results, seed=1, environment=there))
    page = written(tmp_path, first, second)["Plain"]
    assert "Another CPU" in page
    assert "f" * 64 in page


def test_without_curves_there_is_no_plot() -> None:
    assert curve_plot([]) is None
    bare = results("plain")
    bare = replace(bare, captures=[replace(one, curve=[]) for one in bare.captures])
    assert curve_plot(board_rows([make_entry(bare)])) is None


@pytest.mark.slow
def test_a_page_is_legible_on_a_desk_and_on_a_phone(tmp_path: Path) -> None:
    """WCAG AA asks for a contrast of 4.5; only tables may be scrolled sideways."""
    entries = [make_entry(replace(results("trimmed"), seed=seed)) for seed in (0, 1)]
    site = build_site(tmp_path / "site", entries)
    page = next((site.parent / "methods").glob("*.html"))
    with open_page(page, tmp_path / "profile") as driver:
        assert "Trimmed" in driver.title
        for width in (DESK, PHONE):
            for dark in (False, True):
                show(driver, width, dark=dark)
                assert least_contrast(driver) >= 4.5
                assert overflow(driver) <= 0
