"""The HTML report. Oracles: the standard HTML parser; what a page may load; values by hand."""

from __future__ import annotations

import re
from dataclasses import replace
from html.parser import HTMLParser
from pathlib import Path

import numpy as np
import pytest

from hwp_bench.analysis.statistics.pairing import group_runs
from hwp_bench.base.errors import UsageError
from hwp_bench.base.files import write_json
from hwp_bench.base.images import write_image
from hwp_bench.base.tables import Column, Table
from hwp_bench.report.page.album import Album
from hwp_bench.report.page.content import gather_report, summary_sentence
from hwp_bench.report.page.elements import tag, to_html
from hwp_bench.report.page.render import write_report
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
    sentence = summary_sentence(runs)
    assert "has 23.50 dB PSNR (macro mean), +3.00 dB against Plain" in sentence
    assert "failed" not in sentence


def test_pictures_stay_within_their_budget(sources) -> None:
    report = gather_report(*[sources[0], [sources[1]]], image_bytes=900)
    assert report.left_out >= 1
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


def test_tables_mark_ranks_blocks_and_groups() -> None:
    columns = (Column("A"), Column("B", 1, True, "G"))
    table = Table("C", columns, (("x", 1.0), ("y", 2.0), ("z", None)), breaks=(2,))
    html = to_html(table)
    assert "<b>2.0</b>" in html
    assert "<u>1.0</u>" in html
    assert html.count("<tbody>") == 2
    assert '<td class="number">–</td>' in html
    assert ">G</th>" in html


def test_elements_are_escaped() -> None:
    assert tag("td", "<&", class_='"', tabindex=0) == (
        '<td class="&#34;" tabindex="0">&lt;&amp;</td>'
    )
