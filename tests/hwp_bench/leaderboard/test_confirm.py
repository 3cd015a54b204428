"""Checks of entries. Oracle: a run of a small method, and what is changed in its result."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import pytest
from small_captures import CaptureMaker
from toy_method import write_toy_method

from hwp_bench.base.errors import BadResult, UsageError
from hwp_bench.cli.main import main
from hwp_bench.leaderboard.confirm import confirm
from hwp_bench.leaderboard.entries import digest, make_entry, read_entries, write_entry
from hwp_bench.results import read_results, write_results


@pytest.fixture
def made(make_capture: CaptureMaker, tmp_path: Path) -> tuple[Path, Path]:
    """A result with predictions, and the folder of its capture."""
    capture = make_capture("tiny", frames=20, size=32)
    method, out = write_toy_method(tmp_path / "toy"), tmp_path / "out"
    assert main(["evaluate", str(method), "--capture", str(capture.root), "-o", str(out)]) == 0
    return out / "results.json", capture.root


def moved(results, *, psnr: float = 0.0, **changes):
    """The results with another PSNR in every frame."""
    captures = [
        replace(
            capture,
            frames=[
                replace(frame, scores={**frame.scores, "psnr": frame.scores["psnr"] + psnr})
                for frame in capture.frames
            ],
        )
        for capture in results.captures
    ]
    return replace(results, captures=captures, **changes)


def test_the_entry_s_own_results_are_rescored(made, tmp_path: Path, capsys) -> None:
    file, capture = made
    entry = make_entry(read_results(file))
    write_entry(tmp_path / "entries", entry)
    words = ["leaderboard", "confirm", str(file), "--by", "us", "--captures", str(capture)]
    words += ["--entries", str(tmp_path / "entries")]
    capsys.readouterr()
    assert main([*words, "--json"]) == 0
    told = json.loads(capsys.readouterr().out)
    assert (told["kind"], told["verdict"], told["frames"], told["by"]) == (
        "rescored",
        "reproduces",
        2,
        "us",
    )
    (read,) = read_entries(tmp_path / "entries")
    assert (read.level, read.badge) == ("rescored", "scores hold")
    # A score that the predictions do not have, in the entry and in its result.
    wrong = moved(read_results(file), psnr=1.0)
    write_results(file, wrong)
    write_entry(tmp_path / "entries", make_entry(wrong))
    assert main([*words, "--entry", make_entry(wrong).name]) == 1
    assert "rescored, differs (2 frames)" in capsys.readouterr().out
    levels = {item.name: (item.level, item.badge) for item in read_entries(tmp_path / "entries")}
    assert levels[make_entry(wrong).name] == ("self-reported", "differs")


def test_a_second_run_reproduces_within_the_tolerance(made) -> None:
    file, capture = made
    again = read_results(file)
    before = "2020-01-01T00:00:00+00:00"
    for shift, verdict in ((0.0, "reproduces"), (0.09, "reproduces"), (-0.11, "differs")):
        entry = make_entry(moved(again, psnr=shift, started=before))
        check = confirm([entry], file, [capture], by="us")
        assert (check.kind, check.verdict, check.same_predictions) == ("re-run", verdict, 1)
        assert check.scores["psnr"] == pytest.approx(again.scores["psnr"])
        assert (check.rerun, check.tolerance) == (digest(again), 0.1)
    assert confirm([entry], file, [capture], by="us", tolerance=0.2).verdict == "reproduces"


def test_a_second_run_must_hold_itself_and_be_of_the_entry(made) -> None:
    file, capture = made
    again = read_results(file)
    entry = make_entry(replace(again, started="2020-01-01T00:00:00+00:00"))
    write_results(file, moved(again, psnr=0.01))
    with pytest.raises(BadResult, match="is not as it says"):
        confirm([entry], file, [capture], by="us")
    write_results(file, again)
    for changes in (
        {"seed": 5},
        {"budget": {"seconds": 1.0, "steps": None}},
        {"method": replace(again.method, digest="other")},
        {"captures": [replace(again.captures[0], digest="other")]},
    ):
        with pytest.raises(UsageError, match="no entry is of this result or run"):
            confirm([make_entry(replace(entry.results, **changes))], file, [capture], by="us")
    twin = make_entry(replace(entry.results, started="2021-01-01T00:00:00+00:00"))
    with pytest.raises(UsageError, match="several entries fit"):
        confirm([entry, twin], file, [capture], by="us")
    assert confirm([entry, twin], file, [capture], by="us", name=twin.name).entry == twin.name
    with pytest.raises(UsageError, match="not between 0 and 100"):
        confirm([entry], file, [capture], by="us", tolerance=-1.0)
