"""Links to pages of avatars. Oracle: the files that a person has put into a results folder."""

from __future__ import annotations

import re
from dataclasses import replace
from pathlib import Path

import pytest
from made_entries import complete_results

from hwp_bench.base.errors import HwpError
from hwp_bench.leaderboard.entries import make_entry
from hwp_bench.leaderboard.site import build_site
from hwp_bench.report.avatar_pages import MAX_PAGE_BYTES
from hwp_bench.report.page.render import write_report
from hwp_bench.report.sources import ResultsSource

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
