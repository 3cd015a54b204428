"""The layouts of the paper's tables. Oracle: golden files that were looked at.

`HWP_GOLDEN=write pytest tests/hwp_bench/report/test_paper_layouts.py` writes them again.
"""

from __future__ import annotations

import os
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import pytest

from hwp_bench.base.errors import UsageError
from hwp_bench.base.files import write_json
from hwp_bench.base.tables import format_table
from hwp_bench.report.requested_table import TableRequest, make_table
from hwp_bench.results import FrameResult, Results, read_results, write_results

GOLDEN = Path(__file__).with_name("golden")


def _results(make_results, name: str, bonus: float, seed: int = 0) -> Results:
    result = make_results(name)
    captures = []
    rows = (
        ("a", "right", ["illumination"], 20.0),
        ("b", "both", ["hand_object_interaction", "motion_blur"], 25.0),
        ("c", "both", ["motion_blur"], 30.0),
    )
    for identifier, hands, perturbations, psnr in rows:
        scores = {
            "psnr": psnr + bonus - 6,
            "ssim": 0.5,
            "oriented_distance": 0.02 - bonus / 1000,
            "paper_psnr": psnr + bonus + seed / 10,
            "paper_ssim": 0.85 + bonus / 100,
        }
        frames = [FrameResult(18, scores, None)]
        captures.append(
            replace(
                result.captures[0],
                id=identifier,
                hands=hands,
                perturbations=perturbations,
                frames=frames,
            )
        )
    return replace(result, captures=captures, seed=seed, suite="mini")


@pytest.fixture
def folders(make_results, tmp_path) -> list[Path]:
    for name, bonus, seed in (("plain", 0.0, 0), ("mine", 2.0, 0), ("mine", 2.0, 1)):
        folder = tmp_path / f"{name}-{seed}"
        write_results(folder / "results.json", _results(make_results, name, bonus, seed))
        weights = {"frames": [0, 1], "weights": [0.001, 0.002]}
        for capture in "abc" if name == "mine" and not seed else "":
            write_json(folder / "captures" / capture / "diagnostics" / "temporal.json", weights)
    return [tmp_path / "plain-0", tmp_path / "mine-0", tmp_path / "mine-1"]


@pytest.fixture
def ablation(make_results, tmp_path) -> Path:
    variants = []
    for name, thrown, bonus in (("no-dpd", ["dpd"], 1.0), ("full", [], 2.0)):
        result = _results(make_results, "mine", bonus)
        title = "Mine" if not thrown else "Mine without DPD"
        result = replace(result, method=replace(result.method, title=title, settings={"x": bonus}))
        write_results(tmp_path / "ablation" / name / "results.json", result)
        variants.append({"name": name, "thrown": thrown, "results": [f"{name}/results.json"]})
    switches = [
        {"name": "dpd", "title": "DPD", "alternative": False},
        {"name": "pao", "title": "PAO", "alternative": False},
    ]
    record = {"schema": "hwp-ablation/1", "switches": switches, "variants": variants}
    write_json(tmp_path / "ablation" / "ablation.json", record)
    return tmp_path / "ablation"


@pytest.mark.parametrize("number", [1, 2, 3, 4, 5, 6, 7, 8, 9, 10])
def test_layouts_are_as_they_were_looked_at(number: int, folders, ablation) -> None:
    paths = [ablation] if number in (6, 7, 8) else folders
    if number == 9:
        paths = [folders[1]]
    table = make_table(TableRequest(paths, paper=number, published=number > 2))
    for form in ("md", "tex"):
        file = GOLDEN / f"table{number}.{form}"
        text = format_table(table, form)
        if os.environ.get("HWP_GOLDEN") == "write":
            file.parent.mkdir(exist_ok=True)
            file.write_text(text, encoding="utf-8")
        assert text == file.read_text(encoding="utf-8")


def test_a_metric_that_one_seed_lacks_makes_no_column(folders) -> None:
    file = folders[1] / "results.json"
    whole = read_results(file)
    captures = [
        replace(one, frames=[replace(f, scores={**f.scores, "flip": 0.1}) for f in one.frames])
        for one in whole.captures
    ]
    before = format_table(make_table(TableRequest(folders, paper=3)), "md")
    write_results(file, replace(whole, captures=captures))
    assert format_table(make_table(TableRequest(folders, paper=3)), "md") == before


def test_published_rows_are_marked_and_never_ranked(folders) -> None:
    table = make_table(TableRequest(folders, published=True))
    published = [i for i, row in enumerate(table.rows) if "published, other data" in str(row[0])]
    assert published == list(range(2, 6))
    assert table.breaks == (2,)
    assert all(table.rank(row, 1) is None for row in published)
    assert [table.rank(row, 1) for row in (0, 1)] == [1, 0]
    assert any("cannot be compared" in note for note in table.notes)


@pytest.mark.parametrize(
    "change",
    [
        lambda result: replace(result, captures=result.captures[:1]),
        lambda result: replace(result, frames="clean"),
        lambda result: replace(result, protocols={"hwp-v0": {}}),
    ],
    ids=["captures", "frames", "protocols"],
)
def test_results_on_other_data_do_not_stand_in_one_layout(
    change: Callable[[Results], Results], folders
) -> None:
    file = folders[0] / "results.json"
    write_results(file, change(read_results(file)))
    with pytest.raises(UsageError, match="on other data, frames or protocols"):
        make_table(TableRequest(folders, paper=3))


def test_what_makes_no_table_is_refused(folders) -> None:
    with pytest.raises(UsageError, match="publishes no numbers"):
        make_table(TableRequest(folders, by="severity", published=True))
    with pytest.raises(UsageError, match="results are needed"):
        make_table(TableRequest([]))
    with pytest.raises(UsageError, match="made of an ablation"):
        make_table(TableRequest(folders, paper=6))
    with pytest.raises(UsageError, match="temporal weights"):
        make_table(TableRequest(folders[:1], paper=9))
