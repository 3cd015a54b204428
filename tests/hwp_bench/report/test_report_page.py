"""The HTML report. Oracles: the standard HTML parser; what a page may load; values by hand."""

from __future__ import annotations

import re
from collections.abc import Iterator
from dataclasses import replace
from html.parser import HTMLParser
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from browser import DESK, PHONE, least_contrast, open_page, overflow, show
from made_entries import complete_results
from made_results import made_results

from hwp_bench.analysis.compare import rank_methods, verdict
from hwp_bench.analysis.pairing import group_runs
from hwp_bench.base.errors import HwpError, UsageError
from hwp_bench.base.files import write_json
from hwp_bench.base.images import write_image
from hwp_bench.base.tables import Column, Table
from hwp_bench.leaderboard.entries import make_entry
from hwp_bench.leaderboard.site import build_site
from hwp_bench.report.page import (
    gather_report,
    summary_sentence,
    template_environment,
    write_report,
)
from hwp_bench.report.pictures import MAX_PAGE_BYTES, Album
from hwp_bench.report.sources import ResultsSource
from hwp_bench.results import CurvePoint

EVIL = '<script>alert("x")</script>'
VOID = {"meta", "img", "br", "line", "rect", "circle", "polyline", "polygon"}


class Page(HTMLParser):
    """Collects elements and checks that they are closed in order."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.open: list[str] = []
        self.elements: list[tuple[str, dict[str, str | None]]] = []
        self.words: list[str] = []
        self.feed(text)
        self.close()
        assert self.open == []

    def handle_startendtag(self, tag: str, attrs: list) -> None:
        self.elements.append((tag, dict(attrs)))

    def handle_starttag(self, tag: str, attrs: list) -> None:
        self.elements.append((tag, dict(attrs)))
        if tag not in VOID:
            self.open.append(tag)

    def handle_endtag(self, tag: str) -> None:
        if tag not in VOID:
            assert self.open.pop() == tag

    def handle_data(self, data: str) -> None:
        self.words.append(data)


@pytest.fixture
def sources(make_results, make_capture, tmp_path: Path) -> tuple[list[ResultsSource], Path]:
    """Two methods on one capture; the first with a hostile title, pictures and weights."""
    capture = make_capture("capture2")
    found = []
    for name, psnr in (("mine", 23.0), ("plain", 20.0)):
        result = make_results(name, psnr)
        own = replace(
            result.captures[0],
            digest=capture.digest,
            perturbations=["motion_blur"],
            curve=[
                CurvePoint(1, 1.0, 1, {"psnr": psnr - 5}),
                CurvePoint(9, 4.0, 1, {"psnr": psnr}),
            ],
        )
        title = EVIL if name == "mine" else "Plain"
        result = replace(
            result, captures=[own], method=replace(result.method, title=title, digest=name)
        )
        folder = tmp_path / name
        picture = np.full((40, 90, 3), 90, np.uint8)
        write_image(folder / "captures/capture2/pictures/comparison.png", picture)
        found.append(ResultsSource(result, folder))
    diagnostics = tmp_path / "mine" / "captures" / "capture2" / "diagnostics"
    write_json(diagnostics / "temporal.json", {"frames": [0, 1], "weights": [0.001, 0.003]})
    for frame in range(9):
        write_image(diagnostics / "weights" / f"{frame:06d}.png", np.full((20, 20), 200, np.uint8))
    return found, capture.root


@pytest.fixture
def page(sources, tmp_path) -> str:
    found, capture = sources
    return write_report(tmp_path / "page", found, [capture]).read_text(encoding="utf-8")


def test_the_page_is_sound_and_needs_no_network(page: str) -> None:
    parsed = Page(page)
    names = {name for name, _ in parsed.elements}
    assert not names & {"script", "link", "iframe", "object", "base", "form"}
    for name, attributes in parsed.elements:
        for key in ("src", "href", "xlink:href", "action"):
            value = attributes.get(key)
            assert value is None or value.startswith(("data:image/jpeg", "#")), (name, value)
        assert not any(key.startswith("on") for key in attributes)
        assert name != "img" or attributes["alt"]
    assert not re.search(r"url\(|@import|https?://", page)
    targets = [a["href"][1:] for n, a in parsed.elements if n == "a"]
    identifiers = {a.get("id") for _, a in parsed.elements}
    assert set(targets) <= identifiers


def test_damaged_weights_keep_no_page_from_being_made(sources, tmp_path, capsys) -> None:
    found, capture = sources
    place = found[0].place("capture2", "diagnostics", "temporal.json")
    place.write_text("{")
    assert "Plain" in write_report(tmp_path / "page", found, [capture]).read_text("utf-8")
    assert "left out: " in capsys.readouterr().err


def test_what_comes_from_outside_is_escaped(page: str) -> None:
    assert EVIL not in page
    assert EVIL in "".join(Page(page).words)


def test_everything_that_was_asked_for_is_there(page: str) -> None:
    parsed = Page(page)
    text = " ".join(parsed.words)
    for words in (
        "All captures",
        "Ranks by PSNR",
        "Per perturbation",
        "By severity",
        "Bias strength",
        "PSNR: differences",
        "seconds of fitting",
        "Motion Blur, severity 0 to 5",
        "Temporal weight",
        "worst, median and best frame",
        "weight masks, some of 9",
        "predictions p",
    ):
        assert words in text, words
    assert sum(name == "img" for name, _ in parsed.elements) == 3
    classes = [a.get("class") or "" for _, a in parsed.elements]
    for wanted in ("front", "whisker", "severity", "test", "wedge"):
        assert wanted in classes, wanted
    # Every fourth of 20 frames is blurred, but for the two test frames: 1, 5, 9, 13, 17.
    assert classes.count("severity") == 5


def test_the_first_sentence_says_what_the_numbers_say(sources) -> None:
    runs = group_runs([source.results for source in sources[0]])
    sentence = summary_sentence(runs, rank_methods(runs, "psnr"))
    assert "with PSNR 23.50 dB (macro mean): +3.00 dB against Plain" in sentence
    assert verdict(rank_methods(runs, "psnr")) in sentence
    assert "failed" not in sentence


def test_pictures_stay_within_their_budget(sources) -> None:
    report = gather_report(*[sources[0], [sources[1]]], image_bytes=900)
    assert report["left_out"] >= 1
    album = Album(10**6)
    uri = album.take(np.zeros((3000, 2000, 3), np.uint8))
    assert uri.startswith("data:image/jpeg;base64,")
    assert album.left == 10**6 - len(uri)


def test_a_bare_result_makes_a_page_too(make_results, tmp_path) -> None:
    result = make_results()
    bare = replace(result.captures[0], curve=[], perturbations=[])
    page = write_report(tmp_path, [ResultsSource(replace(result, captures=[bare]), None)])
    text = page.read_text(encoding="utf-8")
    Page(text)
    assert "severity of its frames is not shown" in text


def test_results_that_cannot_stand_together_are_refused(make_results, tmp_path) -> None:
    other = make_results("other", digest="e")
    with pytest.raises(UsageError, match="different data"):
        write_report(tmp_path, [ResultsSource(make_results(), None), ResultsSource(other, None)])
    with pytest.raises(UsageError, match="results are needed"):
        write_report(tmp_path, [])
    assert not (tmp_path / "index.html").exists()


def html_of(table: Table) -> str:
    """A table as a report shows it."""
    template = template_environment("hwp_bench.report").get_template("table.html.j2")
    return str(template.module.show(table))


def test_seeds_of_a_method_are_one_row() -> None:
    found = [made_results("mine", lambda c, f, s: 20.0 + s, seed=seed) for seed in (0, 1, 2)]
    found.append(made_results("plain", lambda c, f, s: 21.5))
    tables = gather_report([ResultsSource(one, None) for one in found])["tables"]
    rows = {table.caption: table.rows for table in tables}
    assert [row[:2] for row in rows["All captures"]] == [("Mine", 21.0), ("Plain", 21.5)]
    assert {row[0] for row in rows["Per perturbation"]} == {"Mine", "Plain"}


def test_tables_mark_ranks_blocks_and_groups() -> None:
    columns = (Column("A"), Column("B", 1, True, "G"))
    table = Table("C", columns, (("x", 1.0), ("y", 2.0), ("z", None)), breaks=(2,))
    html = html_of(table)
    assert "<b>2.0</b>" in html
    assert "<u>1.0</u>" in html
    assert html.count("<tbody>") == 2
    assert '<td class="number">–</td>' in html
    assert ">G</th>" in html


def test_texts_of_a_table_are_escaped() -> None:
    evil = '"><&'
    table = Table(evil, (Column("a", group=evil), Column(evil)), ((evil, 1.0),), (evil,))
    html = html_of(table)
    assert evil not in html
    assert html.count("&#34;&gt;&lt;&amp;") == 6
    assert 'aria-label="&#34;&gt;&lt;&amp;"' in html


PAGE = "<!doctype html>\n<title>A hand</title>"


@pytest.fixture
def source(tmp_path: Path) -> ResultsSource:
    results = replace(complete_results("mine", suite_name="smoke"), seed=0)
    return ResultsSource(results, tmp_path / "run")


def put(source: ResultsSource, content: str = PAGE, which: int = 0) -> Path:
    path = source.place(source.results.captures[which].id, "avatar.html")
    assert path is not None
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(content)
    return path


def links(page: Path) -> list[str]:
    return re.findall(r'href="([^"]*avatars/[^"]*)"', page.read_text("utf-8"))


def test_the_report_leads_to_a_copy_of_the_page(source: ResultsSource, tmp_path: Path) -> None:
    put(source)
    page = write_report(tmp_path / "report", [source], avatar_pages=True)
    (link,) = links(page)
    assert (page.parent / link).read_text() == PAGE


def test_avatars_of_two_suites_are_told_apart(tmp_path: Path) -> None:
    sources = []
    for name in ("mini", "full-lite"):  # both have a capture0
        made = replace(complete_results("mine", suite_name=name), seed=0)
        sources.append(ResultsSource(made, tmp_path / name))
        put(sources[-1])
    entries = [make_entry(one.results) for one in sources]
    site = build_site(tmp_path / "site", entries, sources, avatar_pages=True).parent
    (page,) = (site / "methods").glob("*.html")
    text = page.read_text("utf-8")
    assert "of mini</a>" in text
    assert "of full-lite</a>" in text


def test_nothing_is_copied_that_nobody_asked_for(source: ResultsSource, tmp_path: Path) -> None:
    put(source, "<!doctype html><script>alert(1)</script>")
    page = write_report(tmp_path / "report", [source])
    assert links(page) == []
    assert [path.name for path in page.parent.iterdir()] == ["index.html"]


def test_the_page_of_the_method_leads_to_its_avatars(source: ResultsSource, tmp_path: Path) -> None:
    put(source)
    entry = make_entry(source.results)
    site = build_site(tmp_path / "site", [entry], [source], avatar_pages=True).parent
    (page,) = (site / "methods").glob("*.html")
    (link,) = links(page)
    assert (page.parent / link).resolve().read_text() == PAGE
    build_site(site, [entry], [source])
    assert links(next((site / "methods").glob("*.html"))) == []


@pytest.mark.parametrize("kind", ["text", "large", "link", "bytes"])
def test_what_is_no_page_is_refused(source: ResultsSource, tmp_path: Path, kind: str) -> None:
    path = put(source)
    if kind == "text":
        path.write_text("a hand")
    elif kind == "bytes":
        path.write_bytes(b"<!doctype html>\xff")
    elif kind == "large":
        with path.open("r+b") as file:
            file.truncate(MAX_PAGE_BYTES + 1)
    else:
        path.rename(tmp_path / "elsewhere.html")
        path.symlink_to(tmp_path / "elsewhere.html")
    with pytest.raises(HwpError, match=r"avatar\.html"):
        write_report(tmp_path / "report", [source], avatar_pages=True)
    assert not (tmp_path / "report" / "avatars").exists()


EVIL_TITLE = '"><img src=x onerror="document.title=1"><script>document.title=2</script>'
pytestmark = pytest.mark.slow


@pytest.fixture
def browser(tmp_path) -> Iterator[Any]:
    """Chromium at a report of three methods, one with a hostile name, with pictures."""
    sources = []
    for number, title in enumerate(
        (EVIL_TITLE, "A method with a long name of many words", "Plain")
    ):
        result = made_results(f"m{number}", lambda c, f, s, n=number: 20.0 + c + n + 0.1 * f)
        result = replace(result, method=replace(result.method, title=title, digest=str(number)))
        folder = tmp_path / f"m{number}"
        picture = np.full((120, 400, 3), 90, np.uint8)
        for capture in result.captures:
            write_image(folder / f"captures/{capture.id}/pictures/comparison.png", picture)
        sources.append(ResultsSource(result, folder))
    page = write_report(tmp_path / "page", sources)
    with open_page(page, tmp_path / "profile") as driver:
        yield driver


def test_hostile_names_are_words(browser) -> None:
    assert browser.title.startswith("HWP bench: ")
    assert EVIL_TITLE in browser.title
    assert browser.execute_script("return document.scripts.length") == 0
    assert browser.find_elements("css selector", "img[onerror], img[src=x]") == []
    assert EVIL_TITLE in browser.execute_script("return document.body.textContent")
    # Whatever is shown is in the file.
    loaded = "return performance.getEntriesByType('resource').map(e => e.name)"
    assert [name for name in browser.execute_script(loaded) if not name.startswith("data:")] == []
    drawn = "return [...document.images].every(i => i.naturalWidth > 0)"
    assert browser.execute_script(drawn)


@pytest.mark.parametrize("width", [PHONE, DESK])
@pytest.mark.parametrize("dark", [False, True])
def test_it_is_legible_on_a_phone_and_on_a_desk(browser, width: int, dark: bool) -> None:
    """WCAG AA asks for a contrast of 4.5; a first column of 60 px holds more than a letter."""
    show(browser, width, dark=dark)
    assert overflow(browser) <= 0
    assert least_contrast(browser) >= 4.5
    dark_page = browser.execute_script("return getComputedStyle(document.body).backgroundColor")
    assert (dark_page != "rgb(255, 255, 255)") is dark
    widths = browser.execute_script(
        "return [...document.querySelectorAll('td:first-child:not(.number)')]"
        ".filter(c => c.textContent).map(c => c.clientWidth)"
    )
    assert min(widths) >= 60
    wide = "return [...document.images].every(i => i.getBoundingClientRect().right <= innerWidth)"
    assert browser.execute_script(wide)


@pytest.mark.parametrize(("width", "height"), [(PHONE, 800), (DESK, 900)])
def test_the_first_picture_is_on_the_first_screen(browser, width: int, height: int) -> None:
    """On a phone a third of it is enough: hostile and long names fill many lines here."""
    show(browser, width)
    box = "const r = document.images[0].getBoundingClientRect(); return [r.top, r.height]"
    top, tall = browser.execute_script(box)
    assert top + tall / 3 <= height
    assert browser.find_element("id", "look").find_elements("tag name", "img")
    count = "return document.querySelectorAll('#look img').length"
    assert browser.execute_script(count) == 2


def test_no_mouse_is_needed(browser) -> None:
    from selenium.webdriver.common.keys import Keys

    show(browser, PHONE)
    browser.switch_to.active_element.send_keys(Keys.TAB)
    link = browser.switch_to.active_element
    assert link.text == "Plots"
    link.send_keys(Keys.TAB)
    browser.switch_to.active_element.send_keys(Keys.ENTER)
    assert browser.current_url.endswith("#tables")
    # A wide table takes the focus and is scrolled with the arrow keys.
    for _ in range(12):
        browser.switch_to.active_element.send_keys(Keys.TAB)
        region = browser.switch_to.active_element
        if region.get_attribute("aria-label") == "All captures":
            break
    assert region.get_attribute("aria-label") == "All captures"
    region.send_keys(Keys.ARROW_RIGHT)
    from selenium.webdriver.support.ui import WebDriverWait

    WebDriverWait(browser, 5).until(
        lambda _: browser.execute_script("return arguments[0].scrollLeft", region) > 0
    )


def test_it_prints_in_dark_ink_on_paper(browser) -> None:
    show(browser, DESK, dark=True, media="print")
    assert least_contrast(browser) >= 7
    style = "const s = getComputedStyle(document.body); return [s.backgroundColor, s.color]"
    assert browser.execute_script(style) == ["rgb(255, 255, 255)", "rgb(0, 0, 0)"]
    assert not browser.find_element("css selector", "nav").is_displayed()
    clipped = (
        "return [...document.querySelectorAll('.scroll')].map(e => getComputedStyle(e).overflowX)"
    )
    assert set(browser.execute_script(clipped)) == {"visible"}
