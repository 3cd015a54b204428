"""An ablation end to end with a toy method. Oracles: its known costs, arithmetic on its scores."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from small_captures import CaptureMaker
from toy_method import write_toy_method

from hwp_bench.cli.main import main
from hwp_bench.results import read_all, read_results, result_files


def words(method: Path, captures: list, out: Path, *more: str) -> list[str]:
    paths = [str(capture.root) for capture in captures]
    # The toy notes its fits beside itself, which no sandbox would let it.
    base = ["ablate", str(method), "--capture", *paths, "-o", str(out), "--isolation", "none"]
    return [*base, *more]


@pytest.fixture
def captures(make_capture: CaptureMaker) -> list:
    return [
        make_capture("single", frames=20, size=32),
        make_capture("pair", frames=20, size=32, hands="both"),
    ]


def mean_psnr(out: Path, variant: str, capture: int) -> np.ndarray:
    """(seeds,) mean PSNR of one variant on one capture."""
    files = sorted((out / "variants" / variant).glob("seed-*/results.json"))
    return np.array(
        [
            np.mean([f.scores["psnr"] for f in read_results(file).captures[capture].frames])
            for file in files
        ]
    )


@pytest.mark.slow
def test_the_factorial_end_to_end(captures, tmp_path: Path, capsys) -> None:
    method, out = write_toy_method(tmp_path / "toy"), tmp_path / "out"
    assert main(words(method, captures, out, "--seeds", "2")) == 0
    shown = capsys.readouterr()
    assert "Cost of the components" in shown.out
    assert "Gains" in shown.out
    assert "Base row: the method without Tone, Edge; keeps no other" in shown.out
    assert "Where the seconds go" in (out / "tables" / "seconds.md").read_text()
    assert "[1/16] single, no-tone+no-edge, seed 0 (" in shown.err
    assert "[5/16] pair, no-tone, seed 0" in shown.err
    record = json.loads((out / "ablation.json").read_text())
    variants = [variant["name"] for variant in record["variants"]]
    assert variants == ["no-tone+no-edge", "no-tone", "no-edge", "full"]
    assert record["seeds"] == [0, 1]
    # Costs are what the method says of itself: tone takes half as long again, edge a fifth.
    costs = {(row["effect"], row["quantity"]): row for row in record["cost_effects"]}
    assert costs["Tone", "fit"]["percent"] == pytest.approx(50)
    assert costs["Edge", "step"]["percent"] == pytest.approx(20)
    assert costs["Edge", "step"]["low"] == pytest.approx(20)
    assert costs["Edge", "render"]["percent"] == pytest.approx(0, abs=1e-9)
    # Effects are the arithmetic of a factorial on the scores of the result files.
    psnr = {v: np.stack([mean_psnr(out, v, c) for c in (0, 1)]) for v in variants}
    effects = {(row["effect"], row["metric"], row["scope"]): row for row in record["score_effects"]}
    full, tone, edge, none = (psnr[v] for v in ("full", "no-edge", "no-tone", "no-tone+no-edge"))
    expected = ((full - edge) + (tone - none)).mean() / 2
    macro = effects["Tone", "psnr", "macro"]
    assert macro["estimate"]["value"] == pytest.approx(expected, abs=1e-9)
    assert macro["better"] > 0.9
    assert effects["Tone", "oriented_distance", "macro"]["better"] > 0.5
    both = effects["Tone x Edge", "psnr", "interacting"]["estimate"]["value"]
    assert both == pytest.approx((full - tone - edge + none)[1].mean(), abs=1e-9)
    # The first table has the paper's columns.
    table = record["tables"]["ablation"]
    heads = [column["name"] for column in table["columns"]]
    assert heads[:2] == ["Tone", "Edge"]
    assert {"Single PSNR [dB]", "Interacting PSNR [dB]", "Time Step [ms]", "Time Fit [s]"} <= {
        *heads
    }
    assert table["rows"][3]["Single PSNR [dB]"] == pytest.approx(full[0].mean())
    assert table["rows"][3]["Time Fit [s]"] == pytest.approx(3.6)
    for ending in ("md", "tex", "csv", "json"):
        assert (out / "tables" / f"ablation.{ending}").is_file()
    assert (out / "cost" / "pareto.png").is_file()
    # The other commands take the folder for its results.
    assert len(result_files(out)) == len(read_all([out])) == 8
    assert main(["compare", str(out), "--metric", "psnr", "--resamples", "200", "--json"]) == 0
    methods = json.loads(capsys.readouterr().out)["psnr"]["methods"]
    assert methods[0]["label"] == "Toy"
    assert {item["label"] for item in methods} == {
        "Toy", "Toy without Tone", "Toy without Edge", "Toy without Tone, Edge",
    }  # fmt: skip
    # Started again it runs nothing; with a seed more it runs what is new.
    fits = (method.parent / "fits.log").read_text().count("\n")
    assert fits == 16
    assert main(words(method, captures, out, "--seeds", "2")) == 0
    assert (method.parent / "fits.log").read_text().count("\n") == fits
    assert (
        json.loads((out / "ablation.json").read_text())["score_effects"]
        == (record["score_effects"])
    )
    capsys.readouterr()
    assert main(words(method, captures, out, "--without", "edge", "--json")) == 0
    assert (method.parent / "fits.log").read_text().count("\n") == fits + 2 * 2
    value = json.loads(capsys.readouterr().out)
    assert [variant["name"] for variant in value["variants"]] == ["no-edge", "full"]


def test_a_failing_variant_is_named_and_penalised(captures, tmp_path: Path, capsys) -> None:
    method, out = write_toy_method(tmp_path / "toy"), tmp_path / "out"
    more = ("--without", "hard-mask", "--seeds", "1", "--set", "fail=pair")
    assert main(words(method, captures, out, *more)) == 1
    error = capsys.readouterr().err
    assert "failed: Toy with Hard mask, seed 0, pair: 2 of 2 frames" in error
    record = json.loads((out / "ablation.json").read_text())
    assert [row["Failed frames"] for row in record["tables"]["ablation"]["rows"]] == [2, 2]
    # The time of the capture that both got through is still told.
    assert {row["captures"] for row in record["cost_effects"]} == {1}
    log = (method.parent / "fits.log").read_text().splitlines()
    assert log[:2] == ["single 0 True True False", "single 0 True True True"]
    assert log[2:] == ["pair 0 True True True", "pair 0 True True False"]


def test_wrong_switches_are_refused_before_anything_runs(tmp_path: Path, capsys) -> None:
    method = write_toy_method(tmp_path / "toy")
    base = ["ablate", str(method), "-o", str(tmp_path / "out")]
    for words in (["--without", "dpd"], ["--no-dpd"], ["--no-dpd", "--no-pao"]):
        assert main([*base, *words]) == 2
        assert "toy has no switch 'dpd'. It declares: tone, edge, hard-mask" in (
            capsys.readouterr().err
        )
    assert main([*base, "--seeds", "0"]) == 2
    assert main([*base, "--only", "tone", "--without", "edge"]) == 2
    assert not (tmp_path / "out").exists()
