"""The report in headless Chromium, where it is. Oracles: the browser's layout, WCAG contrast."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from browser import DESK, PHONE, least_contrast, open_page, overflow, show
from made_results import made_results

from hwp_bench.base.images import write_image
from hwp_bench.report.page.render import write_report
from hwp_bench.report.sources import ResultsSource

EVIL = '"><img src=x onerror="document.title=1"><script>document.title=2</script>'
pytestmark = pytest.mark.slow


@pytest.fixture
def browser(tmp_path) -> Iterator[Any]:
    """Chromium at a report of three methods, one with a hostile name, with pictures."""
    sources = []
    for number, title in enumerate((EVIL, "A method with a long name of many words", "Plain")):
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
    assert EVIL in browser.title
    assert browser.execute_script("return document.scripts.length") == 0
    assert browser.find_elements("css selector", "img[onerror], img[src=x]") == []
    assert EVIL in browser.execute_script("return document.body.textContent")
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
