"""Results that older versions wrote are read for ever. Oracle: the file's own numbers."""

from __future__ import annotations

import json
from dataclasses import MISSING, fields
from pathlib import Path

import pytest

from hwp_bench.base.files import sha256_json, write_json
from hwp_bench.cli.main import main
from hwp_bench.leaderboard.entries import read_entries
from hwp_bench.results import (
    CaptureResult,
    CurvePoint,
    FrameResult,
    MethodId,
    Results,
    read_results,
)

HERE = Path(__file__).parent
#: Fields that were added within version 1, and what a file without them means.
ADDED = {
    "frames": "perturbed",
    "curve_seconds": None,
    "job_seconds": None,
    "isolation": None,
    "made_by": None,
}


@pytest.mark.parametrize(
    ("name", "captures", "lacks"),
    [
        ("results_version_1_oldest", ["capture0"], set(ADDED)),
        ("results_version_1_before_isolation", ["capture0"], {"isolation", "made_by"}),
        ("results_version_1", ["capture0", "capture4"], {"made_by"}),
    ],
)
def test_results_of_every_version_are_read(name: str, captures: list[str], lacks: set) -> None:
    path = HERE / f"{name}.json"
    raw = json.loads(path.read_text(encoding="utf-8"))
    assert raw["schema"] == "hwp-results/1"
    holders = {name: raw if name == "frames" else raw["captures"][0] for name in ADDED}
    assert {name for name, holder in holders.items() if name not in holder} == lacks
    results = read_results(path)
    assert (results.method.name, results.suite, results.toolkit) == ("plain", "smoke", "0.1.0")
    assert [capture.id for capture in results.captures] == captures
    for field in lacks:
        holder = results if field == "frames" else results.captures[0]
        assert getattr(holder, field) == ADDED[field]
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


def test_what_was_added_to_version_1_may_be_missing() -> None:
    """Every field without a default is in the oldest file, which could not be read otherwise."""
    raw = json.loads((HERE / "results_version_1_oldest.json").read_text(encoding="utf-8"))
    capture = raw["captures"][0]
    examples = {
        Results: raw,
        MethodId: raw["method"],
        CaptureResult: capture,
        FrameResult: capture["frames"][0],
        CurvePoint: capture["curve"][0],
    }
    for kind, example in examples.items():
        required = {
            item.name
            for item in fields(kind)
            if item.default is MISSING and item.default_factory is MISSING
        }
        assert required <= example.keys(), kind


def test_an_entry_of_old_results_keeps_its_digest_and_its_name(tmp_path: Path) -> None:
    raw = json.loads((HERE / "results_version_1_oldest.json").read_text(encoding="utf-8"))
    del raw["schema"]
    digest = sha256_json(raw)
    value = {"schema": "hwp-leaderboard-entry/1", "digest": digest, "results": raw}
    write_json(tmp_path / f"plain-smoke-seed0-{digest[:8]}.json", value)
    assert [entry.results.frames for entry in read_entries(tmp_path)] == ["perturbed"]
