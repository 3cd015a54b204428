"""Tables of evaluations. Oracle: means by hand."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from made_results import made_results

from hwp_bench.base.errors import BadResult, UsageError
from hwp_bench.base.images import write_image
from hwp_bench.base.tables import Column, Table, print_table, to_markdown, write_tables
from hwp_bench.report.page import gather_report
from hwp_bench.report.requested_table import TableRequest, make_table
from hwp_bench.report.sources import ResultsSource
from hwp_bench.report.tables import (
    all_tables,
    free_view_table,
    free_view_tables,
    labels,
    over_seeds,
)
from hwp_bench.results import FrameResult, FreeViewResult, Results, write_results


def _capture(results: Results, name: str, hands: str, perturbations: list[str], psnr: float):
    frames = [
        FrameResult(i, {"psnr": psnr + i, "ssim": 0.5, "paper_psnr": 1.0}, None) for i in (0, 2)
    ]
    return replace(
        results.captures[0],
        id=name,
        hands=hands,
        perturbations=perturbations,
        frames=frames,
    )


@pytest.fixture
def two(make_results) -> list[Results]:
    captures = [
        ("a", "right", ["motion_blur"], 20.0),
        ("b", "both", ["motion_blur", "illumination"], 10.0),
        ("c", "both", ["illumination"], 40.0),
    ]
    plain = make_results("plain")
    first = replace(plain, captures=[_capture(plain, *row) for row in captures])
    better = [(name, hands, p, psnr + 1) for name, hands, p, psnr in captures]
    second = make_results("better")
    second = replace(second, captures=[_capture(second, *row) for row in better])
    return [first, second]


def test_means_are_what_they_are_by_hand(two) -> None:
    tables = all_tables(two)
    row = dict(
        zip(
            [f"{c.group} {c.title}" for c in tables["overall"].columns],
            tables["overall"].rows[0],
            strict=True,
        )
    )
    # Captures: a 21, b 11, c 41; motion blur (21 + 11) / 2 = 16, illumination (11 + 41) / 2 = 26.
    assert row["Single PSNR [dB]"] == pytest.approx(21)
    assert row["Interacting PSNR [dB]"] == pytest.approx(26)
    assert row["Macro PSNR [dB]"] == pytest.approx(21)
    assert row["Cost Fit [s]"] == pytest.approx(2.0)
    assert row["Cost Render [frames/s]"] == pytest.approx(4.0)
    assert row["Cost Failed frames"] == 0
    per = tables["perturbations"]
    assert [c.group for c in per.columns[1::2]] == ["Illumination Variations", "Motion Blur"]
    assert per.rows[1][1] == pytest.approx(27)
    assert per.rows[1][3] == pytest.approx(17)
    assert tables["paper"].rows[0][1] == pytest.approx(1.0)
    assert "over all test frames, each of which counts the same" in tables["micro"].notes[0]
    assert "over captures of means over test frames" in tables["overall"].notes[0]
    assert tables["micro"].rows[0][1] == pytest.approx((20 + 22 + 10 + 12 + 40 + 42) / 6)
    assert [row[2] for row in tables["captures"].rows] == ["Plain", "Better"] * 3


def test_the_better_row_is_marked(two) -> None:
    overall = all_tables(two)["overall"]
    assert [overall.rank(row, 1) for row in (0, 1)] == [1, 0]


def test_results_on_different_data_are_not_compared(two) -> None:
    other = replace(two[1], captures=[replace(two[1].captures[0], digest="other")])
    with pytest.raises(UsageError, match="a: results on different data"):
        all_tables([two[0], other])


def _made_by(results: Results, digest: str, **makers: str) -> Results:
    found = [
        replace(item, made_by=makers[item.id], digest=digest) if item.id in makers else item
        for item in results.captures
    ]
    return replace(results, captures=found)


def test_tables_say_which_importer_made_a_capture(two) -> None:
    assert not any("importer" in note for note in all_tables(two)["overall"].notes)
    assert all_tables(two)["captures"].columns[-1].title == "Failed frames"
    imported = [_made_by(item, "e", a="video 2", b="video 2", c="video 1") for item in two]
    tables = all_tables(imported)
    note = "Hands and masks were made by an importer: a, b by video 2; c by video 1."
    assert note in tables["overall"].notes
    assert tables["captures"].columns[-1].title == "Made by"
    makers = [row[-1] for row in tables["captures"].rows]
    assert makers == ["video 2"] * 4 + ["video 1"] * 2


def test_a_capture_of_another_version_of_the_importer_is_named(two) -> None:
    old, new = _made_by(two[0], "e", a="video 1"), _made_by(two[1], "f", a="video 2")
    with pytest.raises(UsageError, match="one table: made by video 1, and by video 2"):
        all_tables([old, new])
    with pytest.raises(UsageError, match="made by an importer that is not stated, and by video 2"):
        all_tables([two[0], new])


def test_titles_that_repeat_are_told_apart(two) -> None:
    rows = all_tables([two[0], replace(two[0], seed=3)])["overall"].rows
    assert [row[0] for row in rows] == [
        "Plain (seed 0)",
        "Plain (seed 3)",
    ]


def test_every_table_is_written_in_every_spelling(two, tmp_path) -> None:
    write_tables(tmp_path, all_tables(two))
    names = {path.name for path in tmp_path.iterdir()}
    stems = ("overall", "captures", "perturbations", "details", "micro", "paper")
    assert names == {f"{stem}.{form}" for stem in stems for form in ("md", "tex", "csv", "json")}


def results():
    """Two methods; one has three seeds, a decibel apart."""
    mine = [made_results("mine", lambda c, f, s, n=n: 20.0 + n, seed=n) for n in (0, 1, 2)]
    return [mine[0], made_results("plain", lambda c, f, s: 15.0), *mine[1:]]


@pytest.mark.parametrize("name", ["overall", "captures", "perturbations", "details", "micro"])
def test_tables_of_evaluations_show_means_over_seeds(name: str) -> None:
    found = results()
    table = all_tables(found)[name]
    merged = over_seeds(table, found)
    place = [column.title for column in merged.columns].index("Method")
    first = next(
        index for index, column in enumerate(merged.columns) if column.title.startswith("PSNR")
    )
    assert {str(row[place]) for row in merged.rows} == {"Mine", "Plain"}
    assert len(merged.rows) * 2 == len(table.rows)
    for row in merged.rows:
        assert row[first] == pytest.approx(21.0 if row[place] == "Mine" else 15.0)
    assert len(merged.breaks) == len(table.breaks)
    assert "Means over seeds" in merged.notes[-1]


def test_counts_are_added_texts_joined_and_gaps_stay() -> None:
    found = results()
    names = labels(found)
    columns = tuple(
        Column(title) for title in ("Block", "Method", "PSNR", "Failed", "Made by", "LPIPS")
    )
    rows = tuple(
        (block, name, 20.0 + number, number, f"maker {number % 2}", None if number else 0.1)
        for block in ("a", "b")
        for number, name in enumerate(names)
    )
    table = Table("T", columns, rows, breaks=(4,), unranked=frozenset({1, 4}))
    merged = over_seeds(table, found)
    assert merged.rows == (
        ("a", "Mine", pytest.approx(65 / 3), 5, "maker 0, maker 1", None),
        ("a", "Plain", 21.0, 1, "maker 1", None),
        ("b", "Mine", pytest.approx(65 / 3), 5, "maker 0, maker 1", None),
        ("b", "Plain", 21.0, 1, "maker 1", None),
    )
    assert merged.breaks == (2,)
    # A row is left out of the ranks only if all its seeds are.
    assert merged.unranked == {1}


def test_a_table_without_several_seeds_stays_as_it_is() -> None:
    single = results()[:2]
    table = all_tables(single)["overall"]
    assert over_seeds(table, single) is table
    # One evaluation that is given twice is no second seed.
    twice = [single[0], replace(single[0])]
    table = all_tables(twice)["overall"]
    assert over_seeds(table, twice) is table


Maker = Callable[..., Results]
VIEWS = 12


def with_clips(
    results: Results, levels: dict[str, float], digest: str = "clip", *, broken: int = 0
) -> Results:
    """The result on captures with scored clips: PSNR around a level, an even spread of 1 dB."""
    spread = np.linspace(-1.0, 1.0, VIEWS)
    captures = []
    for name, level in levels.items():
        frames = [
            FrameResult(
                view,
                {"psnr": level + spread[view], "ssim": 0.8},
                "gone" if view < broken else None,
            )
            for view in range(VIEWS)
        ]
        clip = FreeViewResult(f"{digest}-{name}", frames, "p")
        captures.append(replace(results.captures[0], id=name, digest=name, free_view=clip))
    return replace(results, captures=captures)


def column(table: Table, title: str, group: str | None = None) -> list[object]:
    place = next(
        index
        for index, item in enumerate(table.columns)
        if item.title == title and group in (None, item.group)
    )
    return [row[place] for row in table.rows]


def test_means_are_over_captures_and_failures_are_counted(make_results: Maker) -> None:
    first = with_clips(make_results("one", 20.0), {"a": 21.0, "b": 27.0})
    second = with_clips(make_results("two", 30.0), {"a": 31.0, "b": 33.0}, broken=2)
    table = free_view_table([first, second])
    assert column(table, "Capture") == ["a", "a", "b", "b", "all", "all"]
    assert column(table, "Method") == ["One", "Two"] * 3
    np.testing.assert_allclose(
        np.array(column(table, "PSNR [dB]"), dtype=float), [21, 31, 27, 33, 24, 32], atol=1e-9
    )
    # The examples' test frames score PSNR and PSNR + 1 dB.
    np.testing.assert_allclose(
        np.array(column(table, "PSNR [dB]", "Test"), dtype=float), [20.5, 30.5] * 3, atol=1e-9
    )
    assert column(table, "Failed") == [0, 2, 0, 2, 0, 4]
    assert table.breaks == (2, 4)
    assert "95 %" in to_markdown(table)
    low, high = (np.array(column(table, name), dtype=float) for name in ("Low", "High"))
    value = np.array(column(table, "PSNR [dB]"), dtype=float)
    assert (low < value).all()
    assert (value < high).all()
    # Two captures that differ by 6 dB say less of further captures than those that differ by 2.
    assert high[4] - low[4] > high[5] - low[5]


def test_the_table_fits_a_terminal(make_results: Maker, capsys) -> None:
    print_table(free_view_table([with_clips(make_results(), {"capture1": 21.0, "capture2": 27.0})]))
    lines = capsys.readouterr().out.splitlines()
    assert max(map(len, lines)) <= 80
    assert any("capture2" in line and "27.00" in line for line in lines)


def test_seeds_are_averaged(make_results: Maker) -> None:
    seeds = [
        replace(with_clips(make_results(), {"a": level}), seed=seed)
        for seed, level in enumerate((20.0, 22.0))
    ]
    table = free_view_table(seeds)
    assert column(table, "Capture") == ["a"]
    np.testing.assert_allclose(column(table, "PSNR [dB]"), [21.0], atol=1e-9)


def test_captures_that_one_lacks_are_left_out(make_results: Maker) -> None:
    first = with_clips(make_results("one"), {"a": 21.0, "b": 27.0})
    second = with_clips(make_results("two"), {"a": 31.0})
    assert set(column(free_view_table([first, second]), "Capture")) == {"a"}
    # Results that know nothing of clips stand aside.
    old = make_results("old")
    assert set(column(free_view_table([first, old]), "Method")) == {"One"}
    assert free_view_tables([old]) == {}


def test_what_cannot_be_compared_is_refused(make_results: Maker, tmp_path: Path) -> None:
    first = with_clips(make_results("one"), {"a": 21.0})
    with pytest.raises(UsageError, match="different free-view clips"):
        free_view_table([first, with_clips(make_results("two"), {"a": 21.0}, "other")])
    with pytest.raises(UsageError, match="no capture has a scored clip"):
        free_view_table([first, with_clips(make_results("two"), {"b": 21.0})])
    clip = first.captures[0].free_view
    assert clip is not None
    for frames in ([], [replace(clip.frames[0], scores={"ssim": 0.5}), *clip.frames[1:]]):
        odd = replace(first.captures[0], free_view=replace(clip, frames=frames))
        with pytest.raises(BadResult, match="psnr"):
            free_view_table([replace(first, captures=[odd])])
    short = replace(first.captures[0], free_view=replace(clip, frames=clip.frames[1:]))
    with pytest.raises(UsageError, match="different free-view clips"):
        free_view_table([first, replace(first, captures=[short], seed=1)])
    path = write_results(tmp_path / "results.json", make_results("old"))
    with pytest.raises(UsageError, match="Evaluate again"):
        make_table(TableRequest([path], by="free-view"))


def test_it_is_asked_for_by_name_and_stands_on_the_page(
    make_results: Maker, tmp_path: Path
) -> None:
    results = with_clips(make_results("one"), {"capture2": 21.5})
    path = write_results(tmp_path / "results.json", results)
    table = make_table(TableRequest([path], by="free-view"))
    np.testing.assert_allclose(column(table, "PSNR [dB]"), [21.5], atol=1e-9)
    pictures = tmp_path / "captures" / "capture2" / "pictures"
    write_image(pictures / "free_view.png", np.full((20, 30, 3), 90, np.uint8))
    page = gather_report([ResultsSource(results, tmp_path)])
    assert any("Novel views" in str(item) for item in page["tables"])
    ((method, uri),) = page["captures"][0]["views"]
    assert method == "One"
    assert uri.startswith("data:image/jpeg;base64,")


def test_a_mean_over_seeds_is_not_called_by_one_of_them() -> None:
    found = []
    for seconds, seed in ((30.0, 0), (30.0, 1), (60.0, 1), (60.0, 2)):
        budget = {"seconds": seconds, "steps": None}
        found.append(made_results("mine", lambda c, f, s: 20.0 + c, seed=seed, budget=budget))
    table = over_seeds(all_tables(found)["overall"], found)
    assert [row[0] for row in table.rows] == ["Mine (30 s)", "Mine (60 s)"]
    assert "added up" in table.notes[-1]
