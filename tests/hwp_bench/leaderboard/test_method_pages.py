"""Pages of methods. Oracles: the entries, and the README that ships with a method."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest
from browser import DESK, PHONE, least_contrast, open_page, overflow, show
from made_entries import complete_results
from made_results import made_results

from hwp_bench.leaderboard.board_rows import board_rows
from hwp_bench.leaderboard.curve_plot import curve_plot
from hwp_bench.leaderboard.entries import make_entry
from hwp_bench.leaderboard.method_pages import method_pages, write_method_pages
from hwp_bench.leaderboard.page_row import make_row
from hwp_bench.leaderboard.records import Submission
from hwp_bench.leaderboard.site import build_site
from hwp_bench.methods.manifest import shipped_methods

EVIL = "</td><script>alert(1)</script>"


def rows_of(*entries):
    return [(row, make_row(row)) for row in board_rows(entries)]


def written(folder: Path, *entries, scenes=()) -> dict[str, str]:
    pages = method_pages(rows_of(*entries))
    write_method_pages(folder, pages, scenes)
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
        make_entry(replace(base, method=replace(base.method, name=name, title=EVIL + name)))
        for name in ("../../up", "..", "a/b")
    ]
    pages = method_pages(rows_of(*evil))
    assert len({page.path for page in pages}) == 3
    write_method_pages(tmp_path, pages)
    assert len(list((tmp_path / "methods").iterdir())) == 3
    for file in (tmp_path / "methods").iterdir():
        assert "<script" not in file.read_text("utf-8")


def test_pictures_are_the_first_frame_of_each_capture(tmp_path: Path) -> None:
    entry = make_entry(results("plain"))

    def scene(capture: str, frame: int, name: str) -> dict:
        shot = {"entry": name, "picture": f"p{frame}.jpg", "error": f"e{frame}.jpg", "psnr": 21.0}
        return {"capture": capture, "frame": frame, "truth": f"t{frame}.jpg", "shots": [shot]}

    scenes = [scene("c0", 4, "another"), scene("c0", 5, entry.name), scene("c0", 6, entry.name)]
    page = written(tmp_path, entry, scenes=scenes)["Plain"]
    assert 'src="../p5.jpg"' in page
    assert "p4.jpg" not in page
    assert "p6.jpg" not in page
    assert "21.00 dB" in page


@pytest.mark.parametrize("count", [2, 6])
def test_the_plot_of_a_table_names_every_method_and_the_front(count: int) -> None:
    """A method that starts a decibel higher stays above the others at every time."""

    def run(number: int):
        curve = [(2.0**k, 15.0 + number + k) for k in range(4)]
        found = made_results(f"m{number}", lambda c, f, s: 20.0 + number, curve=curve, seconds=8.0)
        captures = complete_results(suite_name="smoke").captures
        kept = [
            replace(one, id=two.id, split_digest=two.split_digest, frames=two.frames)
            for one, two in zip(found.captures, captures, strict=False)
        ]
        return make_entry(replace(found, suite="smoke", captures=kept))

    plot = curve_plot(board_rows([run(number) for number in range(count)]))
    assert plot is not None
    assert len(plot.methods) == count
    assert list(plot.front) == [f"M{count - 1}"]
    assert plot.figure.count('class="band"') == (count if count <= 4 else 1)


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
