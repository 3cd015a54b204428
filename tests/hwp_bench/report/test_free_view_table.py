"""The table of novel views. Oracles: means by hand, and a bootstrap that scipy computes."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from hwp_bench.base.errors import BadResult, UsageError
from hwp_bench.base.images import write_image
from hwp_bench.base.tables import Table, print_table, to_markdown
from hwp_bench.report.free_view_table import free_view_table, free_view_tables
from hwp_bench.report.page.content import gather_report
from hwp_bench.report.requested_table import TableRequest, make_table
from hwp_bench.report.sources import ResultsSource
from hwp_bench.results import FrameResult, FreeViewResult, Results, write_results

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
    assert any("Novel views" in str(item) for item in page.tables)
    ((method, uri),) = page.captures[0].views
    assert method == "One"
    assert uri.startswith("data:image/jpeg;base64,")
