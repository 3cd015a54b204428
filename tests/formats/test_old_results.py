"""Results that older versions wrote are read for ever. Oracle: the file's own numbers."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from hwp_bench.cli.main import main
from hwp_bench.results import read_results

HERE = Path(__file__).parent


@pytest.mark.parametrize("version", [1])
def test_results_of_every_version_are_read(version: int) -> None:
    path = HERE / f"results_version_{version}.json"
    raw = json.loads(path.read_text(encoding="utf-8"))
    assert raw["schema"] == f"hwp-results/{version}"
    results = read_results(path)
    assert (results.method.name, results.suite, results.toolkit) == ("plain", "smoke", "0.1.0")
    assert [capture.id for capture in results.captures] == ["capture0", "capture4"]
    for capture, rows in zip(results.captures, raw["captures"], strict=True):
        assert capture.predictions_digest == rows["predictions_digest"]
        assert [frame.scores for frame in capture.frames] == [f["scores"] for f in rows["frames"]]
        assert [point.step for point in capture.curve] == [p["step"] for p in rows["curve"]]


def test_they_still_make_tables(capsys: pytest.CaptureFixture[str]) -> None:
    path = HERE / "results_version_1.json"
    assert main(["table", str(path), "--by", "captures"]) == 0
    printed = capsys.readouterr().out
    frames = read_results(path).captures[0].frames
    mean = sum(frame.scores["psnr"] for frame in frames) / len(frames)
    assert f"{mean:.2f}" in printed
