"""The site's viewer. Oracles: the truth as an entry, and headless Chromium that is used by hand."""

from __future__ import annotations

import json
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from browser import DESK, PHONE, least_contrast, open_page, overflow, show
from small_captures import CaptureMaker, results_example

from hwp_bench.base.files import sha256_json
from hwp_bench.base.images import write_image
from hwp_bench.capture import Capture
from hwp_bench.capture.schema import frame_name
from hwp_bench.leaderboard import board_rows, site
from hwp_bench.leaderboard.entries import make_entry
from hwp_bench.leaderboard.gallery import FRAMES, _spread
from hwp_bench.leaderboard.site import build_site
from hwp_bench.metrics import PROTOCOLS
from hwp_bench.report.sources import ResultsSource
from hwp_bench.results import FrameResult

EVIL = "</script><img src=x onerror=alert(1)>"
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
        entry_of(tmp_path / "half", capture, EVIL, gain=0.5),
    ]
    digest = sha256_json(capture.info.to_json())
    # Captures are found in the toolkit's cache; this one lies elsewhere.
    monkeypatch.setattr(site, "open_captures_of", lambda results: {digest: capture})
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
    monkeypatch.setattr(site, "open_captures_of", lambda results: captures)
    # One capture is a whole suite here.
    monkeypatch.setattr(board_rows, "missing", lambda results: [])
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


@pytest.mark.parametrize("count", [1, 2, FRAMES, FRAMES + 1, 50])
def test_frames_are_spread_over_the_clip(count: int) -> None:
    found = _spread(list(range(count)))
    assert len(found) == min(count, FRAMES) == len(set(found))
    assert (found[0], found[-1]) == (0, count - 1)
    steps = np.diff(found)
    assert len(steps) == 0 or steps.max() - steps.min() <= 1


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
    assert [option.text for option in right.options] == ["Truth", "Truth as an entry", EVIL]
    assert driver.find_elements("css selector", "img[src=x]") == []
    before = driver.find_element("id", "viewer-right-picture").get_attribute("src")
    right.select_by_visible_text(EVIL)
    after = driver.find_element("id", "viewer-right-picture").get_attribute("src")
    assert before != after
    assert driver.find_element("id", "viewer-right-caption").text.startswith(EVIL)
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
