"""Tables of evaluations. Oracle: means by hand."""

from __future__ import annotations

from dataclasses import replace

import pytest

from hwp_bench.base.errors import UsageError
from hwp_bench.base.tables import write_tables
from hwp_bench.report.evaluation_tables import all_tables
from hwp_bench.results import FrameResult, Results


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
