"""Comparing results. Oracles: known differences put into made results; arithmetic."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from made_results import made_results

from hwp_bench.analysis.statistics.compare import compare, macro_by_seed, standings
from hwp_bench.analysis.statistics.pairing import group_runs, refuse_unlike, scopes
from hwp_bench.base.errors import UsageError
from hwp_bench.cli.main import main
from hwp_bench.metrics.score import aggregate
from hwp_bench.results import Results, write_results
from hwp_bench.results.schema import score_rows


def noise(capture: int, frame: int, seed: int) -> float:
    """Difficulty of a frame, the same for every method."""
    return float(20 + 3 * np.sin(7 * capture) + np.cos(frame))


def better_by(gain: float):
    return lambda c, f, s: noise(c, f, s) + gain * (1 + 0.1 * np.sin(5 * c + f + s))


def test_a_difference_is_found_and_signed() -> None:
    runs = group_runs([made_results("mine", better_by(2)), made_results("plain", noise)])
    found = compare(runs, "psnr", resamples=2000)
    assert [item.scope for item in found] == [
        "macro", "single", "interacting", "illumination", "motion_blur",
    ]  # fmt: skip
    macro = found[0]
    assert macro.estimate.value == pytest.approx(2, abs=0.2)
    assert 1.5 < macro.estimate.low < macro.estimate.value < macro.estimate.high < 2.5
    assert macro.better > 0.99
    assert macro.estimate.captures == 4
    # A smaller distance is better, so the first is still the better one.
    distance = compare(runs, "oriented_distance", resamples=2000)[0]
    assert distance.estimate.value == pytest.approx(-0.02, abs=0.002)
    assert distance.better > 0.99


def test_perturbations_are_adjusted_together() -> None:
    runs = group_runs([made_results("mine", better_by(2)), made_results("plain", noise)])
    found = {item.scope: item for item in compare(runs, "psnr", resamples=2000)}
    pair = [found["illumination"], found["motion_blur"]]
    smaller, larger = sorted(item.estimate.p for item in pair)
    assert sorted(item.p_adjusted for item in pair) == pytest.approx(
        [2 * smaller, max(2 * smaller, larger)]
    )
    assert found["single"].p_adjusted is None


def test_equal_methods_tie_and_an_unequal_one_stands_apart() -> None:
    def similar(c: int, f: int, s: int) -> float:
        return noise(c, f, s) + 0.05 * (-1) ** c

    made = [
        made_results("plain", noise),
        made_results("best", better_by(5)),
        made_results("twin", similar),
    ]
    runs = group_runs(made)
    found = standings(runs, "psnr", compare(runs, "psnr", resamples=2000))
    assert {item.label: item.ties for item in found} == {"Best": "a", "Plain": "b", "Twin": "b"}
    assert found[0].label == "Best"


def test_seeds_of_one_method_are_one_method() -> None:
    def seeded(c: int, f: int, s: int) -> float:
        return noise(c, f, s) + s

    made = [made_results("mine", seeded, seed=s) for s in (2, 0, 1)]
    runs = group_runs([*made, *(made_results("plain", noise, seed=s) for s in (1, 2))])
    assert [run.label for run in runs] == ["Mine", "Plain"]
    found = compare(runs, "psnr", resamples=500)
    assert found[0].estimate.value == pytest.approx(1.5)
    first = standings(runs, "psnr", found)[0]
    assert (first.label, first.seeds, first.seed_deviation) == ("Mine", 3, pytest.approx(1.0))
    with pytest.raises(UsageError, match="two results are of Mine with seed 2"):
        group_runs([made[0], made[0]])
    with pytest.raises(UsageError, match="have no seed in common"):
        compare(group_runs([made[1], made_results("plain", noise, seed=1)]), "psnr")


def test_the_macro_mean_is_that_of_the_tables() -> None:
    results = made_results("mine", noise, captures=3)
    run = group_runs([results])[0]
    table = aggregate(score_rows(results)).overall.macro["psnr"]
    assert macro_by_seed(run, "psnr") == pytest.approx([table], abs=1e-12)
    assert scopes(results)["macro"] == {"capture0": 0.5, "capture1": 0.5, "capture2": 1.0}
    bare = replace(results, captures=[replace(c, perturbations=[]) for c in results.captures])
    assert list(scopes(bare)) == ["macro", "single", "interacting"]
    assert set(scopes(bare)["macro"].values()) == {1.0}


def changed(**fields: object) -> Results:
    results = made_results("other", noise)
    return replace(results, captures=[replace(c, **fields) for c in results.captures])


@pytest.mark.parametrize(
    ("other", "reason"),
    [
        (made_results("other", noise, captures=3), r"not evaluated on the same captures \(cap"),
        (changed(digest="e"), "on different data under the name capture0"),
        (changed(digest="e", made_by="video 2"), "not stated, and by video 2"),
        (changed(split_digest="e"), "on different splits under the name capture0"),
        (made_results("other", noise, frames=5), "on different test frames under"),
        (made_results("other", noise, protocols={"hwp-v1": {}}), r"different protocols \(hwp-v1"),
        (replace(changed(), frames="clean"), r"training frames \(perturbed and clean\)"),
    ],
    ids=["captures", "data", "importer", "split", "frames", "protocol", "choice"],
)
def test_what_differs_in_more_than_the_method_is_refused(other: Results, reason: str) -> None:
    with pytest.raises(UsageError, match=reason):
        refuse_unlike(group_runs([made_results("plain", noise), other]))


def test_labels_are_told_apart() -> None:
    base = made_results("mine", noise)
    budget = {"seconds": 60.0, "steps": None}
    labels = [run.label for run in group_runs([base, replace(base, budget=budget)])]
    assert labels == ["Mine (default)", "Mine (default, 60 s)"]
    other = replace(base, method=replace(base.method, settings={"steps": 11}))
    labels = [run.label for run in group_runs([base, other])]
    assert labels == ["Mine (steps = 10)", "Mine (steps = 11)"]
    code = replace(base, method=replace(base.method, digest="d" * 64))
    assert [run.label for run in group_runs([base, code])][1] == "Mine (default, dddddddd)"


def test_the_command_prints_tables_and_json_and_refuses(tmp_path: Path, capsys) -> None:
    paths = []
    for name, gain in (("mine", 2.0), ("plain", 0.0)):
        write_results(tmp_path / name / "results.json", made_results(name, better_by(gain)))
        paths.append(str(tmp_path / name))
    assert main(["compare", *paths, "--resamples", "500"]) == 0
    shown = capsys.readouterr().out
    assert "PSNR: differences" in shown
    assert "Motion" in shown
    assert main(["compare", *paths, "--resamples", "500", "--json"]) == 0
    value = json.loads(capsys.readouterr().out)
    assert value["psnr"]["methods"][0]["label"] == "Mine"
    assert value["psnr"]["differences"][0]["estimate"]["low"] > 1
    assert main(["compare", *paths, "--format", "md", "--metric", "psnr"]) == 0
    assert capsys.readouterr().out.count("**PSNR: ") == 2
    assert main(["compare", paths[0]]) == 2
    assert "only one method" in capsys.readouterr().err
    assert main(["compare", *paths, "--metric", "ssim"]) == 2
    write_results(tmp_path / "b" / "results.json", changed(digest="e"))
    assert main(["compare", paths[0], str(tmp_path / "b")]) == 2
    error = capsys.readouterr().err
    assert "different data under the name capture0" in error
    assert error.count("\n") == 2
