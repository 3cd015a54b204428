"""Robustness, severity, bias and seed tables. Oracle: by hand."""

from __future__ import annotations

import json
from dataclasses import replace

import pytest

from hwp_bench.base.errors import BadResult, UsageError
from hwp_bench.base.files import write_json
from hwp_bench.capture import Capture
from hwp_bench.report.requested_table import TableRequest, make_table
from hwp_bench.report.sources import (
    ResultsSource,
    find_captures,
    mean_severity,
    mean_temporal_weight,
    temporal_weights,
)
from hwp_bench.report.study_tables import robustness_table
from hwp_bench.results import Results, write_results


def cells(table) -> list[dict]:
    names = [f"{c.group} {c.title}".strip() for c in table.columns]
    return [dict(zip(names, row, strict=True)) for row in table.rows]


@pytest.fixture
def on_disk(make_results, make_capture, tmp_path) -> tuple[ResultsSource, Capture]:
    """A result on a capture whose training frames have motion blur of mean severity 0.75."""
    capture = make_capture("capture2")
    plain = make_results("plain")
    scored = replace(
        plain.captures[0], digest=capture.digest, perturbations=list(capture.info.perturbations)
    )
    results = replace(plain, captures=[scored])
    write_results(tmp_path / "run" / "results.json", results)
    return ResultsSource(results, tmp_path / "run"), capture


def test_the_gap_is_what_it_is_by_hand(make_results) -> None:
    def run(name: str, psnr: float, frames: str) -> ResultsSource:
        return ResultsSource(replace(make_results(name, psnr), frames=frames), None)

    sources = [
        run("plain", 20, "perturbed"),
        run("mine", 23, "perturbed"),
        run("mine", 24, "clean"),
    ]
    row = cells(robustness_table(sources, "plain"))[0]
    # Two frames, psnr and psnr + 1: means 20.5, 23.5, 24.5.
    assert row["PSNR Perturbed"] == pytest.approx(23.5)
    assert row["PSNR Clean"] == pytest.approx(24.5)
    assert row["PSNR Change [%]"] == pytest.approx(-100 / 24.5)
    assert row["PSNR Gap closed [%]"] == pytest.approx(100 * 3 / 4)
    # Equal SSIM everywhere leaves no gap that could be closed.
    assert row["SSIM Gap closed [%]"] is None
    assert cells(robustness_table(sources))[0]["PSNR Gap closed [%]"] is None


def test_the_gap_is_counted_from_the_base_of_the_same_budget(make_results) -> None:
    def run(name: str, psnr: float, seconds: float, frames: str = "perturbed") -> ResultsSource:
        budget = {"seconds": seconds, "steps": None}
        result = replace(make_results(name, psnr), frames=frames, budget=budget)
        return ResultsSource(result, None)

    mine = [run("mine", 23, 64.0), run("mine", 24, 64.0, "clean")]
    mine += [run("mine", 21, 16.0), run("mine", 24, 16.0, "clean")]
    plain = [run("plain", 20, 16.0), run("plain", 22, 64.0)]
    rows = cells(robustness_table([*plain, *mine], "plain"))
    # (23 - 22) / (24 - 22) and (21 - 20) / (24 - 20).
    closed = {row["Method"]: row["PSNR Gap closed [%]"] for row in rows}
    assert len(closed) == 2
    assert sorted(closed.values()) == [pytest.approx(25), pytest.approx(50)]
    # None of the two has the budget of this one.
    short = [run("mine", 23, 5.0), run("mine", 24, 5.0, "clean")]
    rows = cells(robustness_table([*plain, *short], "plain"))
    assert rows[0]["PSNR Gap closed [%]"] is None


def test_robustness_is_of_the_seeds_that_all_have(make_results) -> None:
    def run(name: str, psnr: float, seed: int, frames: str = "perturbed") -> ResultsSource:
        return ResultsSource(replace(make_results(name, psnr), frames=frames, seed=seed), None)

    mine = [run("mine", 23, 0), run("mine", 29, 1), run("mine", 24, 0, "clean")]
    plain = [run("plain", 20, 0), run("plain", 10, 2)]
    row = cells(robustness_table([*mine, *plain], "plain"))[0]
    # Seed 0 alone: 23 of 24 from 20 on.
    assert row["PSNR Perturbed"] == pytest.approx(23.5)
    assert row["PSNR Gap closed [%]"] == pytest.approx(75)
    with pytest.raises(UsageError, match="no seed in common"):
        robustness_table([*mine, plain[1]], "plain")


def test_robustness_needs_both_kinds_of_frames(make_results) -> None:
    sources = [ResultsSource(make_results(), None)]
    with pytest.raises(UsageError, match="perturbed and on clean frames"):
        robustness_table(sources)
    clean = ResultsSource(replace(make_results(), frames="clean"), None)
    with pytest.raises(UsageError, match="Given: plain"):
        robustness_table([*sources, clean], "other")


def test_severity_is_that_of_the_frames_to_learn_from(on_disk) -> None:
    source, capture = on_disk
    # Every fourth of 18 frames has severity 3: frames 1, 5, 9, 13, 17.
    assert mean_severity(capture.info, [18, 19]) == {"motion_blur": pytest.approx(15 / 18)}
    assert mean_severity(capture.info, [18, 19], perturbed_only=True) == {"motion_blur": 3.0}
    assert find_captures([source.results]) == {}
    table = make_table(TableRequest([source.folder], by="severity", captures=[capture.root]))
    row = cells(table)[0]
    assert (row["Perturbation"], row["Severity"], row["Captures"]) == ("Motion Blur", 3, 1)
    assert row["PSNR [dB]"] == pytest.approx(20.5)
    with pytest.raises(UsageError, match="severity of none"):
        make_table(TableRequest([source.folder], by="severity"))


def test_bias_is_the_mean_weight(on_disk) -> None:
    source, capture = on_disk
    folder = source.place("capture2", "diagnostics")
    # The sign of a weight can be turned together with what it weighs: it says nothing.
    write_json(folder / "temporal.json", {"frames": [1, 0], "weights": [-0.003, 0.001]})
    assert temporal_weights(source, "capture2")[""].weights == [0.001, 0.003]
    row = cells(make_table(TableRequest([source.folder], by="bias", captures=[capture.root])))[0]
    assert row["Mean temporal weight [1e-3]"] == pytest.approx(2.0)
    assert row["Disturbance"] == "Low"
    # Of the two frames the second alone is perturbed, and has the larger weight.
    assert row["Rank correlation"] == pytest.approx(1.0)
    write_json(folder / "temporal.json", {"frames": [0, 1], "weights": [0.5, 0.5]})
    row = cells(make_table(TableRequest([source.folder], by="bias", captures=[capture.root])))[0]
    assert row["Rank correlation"] is None
    table = make_table(TableRequest([source.folder], paper=9, published=True))
    assert len(table.rows) == 4
    assert "published" in table.rows[-1][0]


def test_bias_is_a_mean_over_seeds(on_disk) -> None:
    source, capture = on_disk
    for seed, weight in ((0, 0.001), (1, 0.003)):
        folder = source.folder.with_name(f"seed{seed}")
        write_results(folder / "results.json", replace(source.results, seed=seed))
        place = folder / "captures" / "capture2" / "diagnostics" / "temporal.json"
        write_json(place, {"frames": [0, 1], "weights": [0.0, weight]})
    paths = [source.folder.with_name(f"seed{seed}") for seed in (0, 1)]
    (row,) = cells(make_table(TableRequest(paths, by="bias", captures=[capture.root])))
    assert row["Method"] == source.results.method.title
    assert row["Mean temporal weight [1e-3]"] == pytest.approx(1.0)
    (row,) = make_table(TableRequest(paths, paper=9, captures=[capture.root])).rows
    assert row[0] == "capture2"
    assert row[-1] == pytest.approx(1.0)


@pytest.mark.parametrize(
    "value",
    [
        {"frames": [0], "weights": [1.0, 2.0]},
        {"frames": [], "weights": []},
        {"frames": [-1], "weights": [1.0]},
        {"frames": [0], "weights": ["x"]},
        {"weights": [1.0]},
        {"frames": [10**6], "weights": [1.0]},
        {"frames": [0], "weights": [1e308]},
    ],
)
def test_unfit_weights_are_refused(on_disk, value, capsys) -> None:
    source, _ = on_disk
    write_json(source.place("capture2", "diagnostics") / "temporal.json", value)
    with pytest.raises(BadResult):
        temporal_weights(source, "capture2")
    # What a method left about itself keeps no table from being made.
    assert mean_temporal_weight(source, "capture2") is None
    assert "left out: " in capsys.readouterr().err


def test_the_spread_over_seeds(make_results: Results, tmp_path) -> None:
    for seed, psnr in enumerate((20.0, 22.0)):
        result = replace(make_results("plain", psnr), seed=seed)
        write_results(tmp_path / str(seed) / "results.json", result)
    paths = [tmp_path / "0", tmp_path / "1"]
    row = cells(make_table(TableRequest(paths, by="seeds")))[0]
    assert row["PSNR [dB] Mean"] == pytest.approx(21.5)
    assert row["PSNR [dB] Deviation"] == pytest.approx(2**0.5)
    assert row["Seeds"] == 2


def test_an_ablation_without_variants_is_named(tmp_path) -> None:
    (tmp_path / "ablation.json").write_text(json.dumps({"schema": "hwp-ablation/1"}))
    with pytest.raises(BadResult, match="variants"):
        make_table(TableRequest([tmp_path], paper=6))
