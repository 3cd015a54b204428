"""Headless Chromium for the tests of pages; they are skipped where it or its driver is missing."""

from __future__ import annotations

import shutil
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest

_FLAGS = (
    *("--headless", "--no-sandbox", "--disable-gpu", "--disable-quic", "--no-first-run"),
    *("--disable-background-networking", "--disable-component-update", "--disable-sync"),
)
#: Width of a phone and of a desk's window, px.
PHONE, DESK = 400, 1400


def _program(*names: str) -> str:
    for name in names:
        path = shutil.which(name)
        if path:
            return path
    pytest.skip(f"{names[0]} is not here")


@contextmanager
def open_page(page: Path, profile: Path, flags: Sequence[str] = ()) -> Iterator[Any]:
    """Open a page in Chromium; at the end nothing may have been complained of in its console.

    Args:
        page: the file.
        profile: a folder for the browser.
        flags: more of them for the browser.

    Yields:
        A selenium driver.
    """
    binary = _program("chromium", "google-chrome", "chromium-browser")
    chromedriver = _program("chromedriver")
    webdriver = pytest.importorskip("selenium.webdriver")
    from selenium.webdriver.chrome.service import Service

    options = webdriver.ChromeOptions()
    options.binary_location = binary
    for flag in (*_FLAGS, *flags, f"--user-data-dir={profile}"):
        options.add_argument(flag)
    options.set_capability("goog:loggingPrefs", {"browser": "ALL"})
    driver = webdriver.Chrome(options=options, service=Service(chromedriver))
    try:
        show(driver)
        driver.get(page.as_uri())
        yield driver
        assert [e for e in driver.get_log("browser") if e["level"] == "SEVERE"] == []
    finally:
        driver.quit()


def show(driver: Any, width: int = DESK, *, dark: bool = False, media: str = "screen") -> None:
    """Show the page at a width, in light or dark, on the screen or as it is printed."""
    size = {"width": width, "height": 900, "deviceScaleFactor": 1, "mobile": width <= PHONE}
    driver.execute_cdp_cmd("Emulation.setDeviceMetricsOverride", size)
    scheme = {"name": "prefers-color-scheme", "value": "dark" if dark else "light"}
    driver.execute_cdp_cmd("Emulation.setEmulatedMedia", {"media": media, "features": [scheme]})


def overflow(driver: Any) -> int:
    """Return by how many pixels the page is wider than its window."""
    return driver.execute_script(
        "return document.documentElement.scrollWidth - document.documentElement.clientWidth"
    )


def least_contrast(driver: Any) -> float:
    """Return the least WCAG contrast of any text with the page behind it.

    Backgrounds count where they are opaque; text in pictures does not.
    """
    return driver.execute_script(_CONTRAST)


_CONTRAST = """
function channels(text) { return text.match(/[0-9.]+/g).map(Number); }
function luminance(text) {
  const [r, g, b] = channels(text).map(c => c / 255)
    .map(c => c <= 0.04045 ? c / 12.92 : Math.pow((c + 0.055) / 1.055, 2.4));
  return 0.2126 * r + 0.7152 * g + 0.0722 * b;
}
function behind(element) {
  for (; element; element = element.parentElement) {
    const found = getComputedStyle(element).backgroundColor;
    const parts = channels(found);
    if (parts.length < 4 || parts[3] === 1) { return found; }
  }
  return "rgb(255, 255, 255)";
}
let least = 21;
for (const element of document.querySelectorAll("body *")) {
  const words = [...element.childNodes].some(n => n.nodeType === 3 && n.textContent.trim());
  if (!words || !element.getClientRects().length) { continue; }
  const style = getComputedStyle(element);
  const ink = element instanceof SVGElement ? style.fill : style.color;
  const [a, b] = [luminance(ink), luminance(behind(element))].sort((x, y) => y - x);
  least = Math.min(least, (a + 0.05) / (b + 0.05));
}
return least;
"""
