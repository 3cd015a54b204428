"""Submissions. Oracles: hashlib, the files that are written, and what was changed on purpose."""

from __future__ import annotations

import hashlib
import json
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from made_entries import complete_results
from small_captures import CaptureMaker
from toy_method import write_toy_method

from hwp_bench.base.errors import BadResult, UsageError
from hwp_bench.base.images import write_image
from hwp_bench.base.packages import data_folder
from hwp_bench.capture.schema import frame_name
from hwp_bench.cli.main import main
from hwp_bench.evaluation.scoring import predictions_digest, read_predictions
from hwp_bench.leaderboard.entries import digest, make_entry, read_entries, write_entry
from hwp_bench.leaderboard.submit import confirm, entry_of
from hwp_bench.methods.manifest import read_manifest
from hwp_bench.methods.source import write_method
from hwp_bench.results import read_results, write_results
from hwp_bench.sim.produce.capture import suite


@pytest.fixture
def run(tmp_path: Path) -> Path:
    """A results folder of the suite smoke with predictions and avatars."""
    results, place = complete_results("mine"), tmp_path / "run"
    size = suite("smoke")[0].size
    captures = []
    for number, capture in enumerate(results.captures):
        folder = place / "captures" / capture.id / "predictions"
        frames = [frame.frame for frame in capture.frames]
        folder.mkdir(parents=True)
        for frame in frames:
            pixels = np.full((size, size, 3), 10 * number + frame, np.uint8)
            write_image(folder / frame_name(frame), pixels)
        digest = predictions_digest(read_predictions(folder, frames, (size, size)))
        captures.append(replace(capture, predictions_digest=digest))
    write_results(place / "results.json", replace(results, captures=captures))
    avatars = tmp_path / "avatars"
    (avatars / "capture4").mkdir(parents=True)
    (avatars / "capture4" / "a.npz").write_bytes(b"left")
    (avatars / "capture0.npz").write_bytes(b"right")
    return place


def submit(run: Path, out: Path, *options: str, entries: Path | None = None) -> int:
    place = entries or out.parent / "no-entries"
    words = ["leaderboard", "submit", str(run), "-o", str(out), "--entries", str(place)]
    return main([*words, *options])


@pytest.mark.parametrize(
    ("changes", "problem"),
    [({"title": "WildGHand"}, "a method that ships"), ({}, "is not yet")],
)
def test_what_the_board_would_refuse_is_not_written(
    run: Path, tmp_path: Path, capsys, changes: dict[str, str], problem: str
) -> None:
    results = read_results(run / "results.json")
    started = results.started if changes else "2999-01-01T00:00:00+00:00"
    method = replace(results.method, **changes)
    write_results(run / "results.json", replace(results, method=method, started=started))
    assert submit(run, tmp_path / "out") != 0
    assert problem in capsys.readouterr().err
    assert not (tmp_path / "out").exists()


def test_a_submission_is_what_a_pull_request_needs(run: Path, tmp_path: Path, capsys) -> None:
    out = tmp_path / "out"
    before = sorted(data_folder("leaderboard").rglob("*"))
    options = ["--author", "A | Person", "--link", "code=https://a.b/c", "--json"]
    assert submit(run, out, *options, "--avatars", str(tmp_path / "avatars")) == 0
    (facts,) = json.loads(capsys.readouterr().out)
    assert sorted(data_folder("leaderboard").rglob("*")) == before
    entries = out / "leaderboard" / "entries"
    (entry,) = read_entries(entries)
    assert sorted(p.name for p in out.rglob("*") if p.is_file()) == [
        "PULL_REQUEST.md",
        f"{entry.name}.json",
    ]
    assert (facts["entry"], facts["level"], facts["badge"]) == (
        entry.name,
        "self-reported",
        "not tried",
    )
    right, left = (hashlib.sha256(content) for content in (b"right", b"left"))
    folder = hashlib.sha256(b"a.npz\0" + left.digest()).hexdigest()
    assert entry.submission.avatars == {"capture0": right.hexdigest(), "capture4": folder}
    text = (out / "PULL_REQUEST.md").read_text("utf-8")
    assert "submitted by A  Person" in text
    assert "predictions at hand of 2 of 2 captures" in text
    for capture in entry.results.captures:
        assert f"| {capture.id} | `{capture.predictions_digest}` | `" in text
    # What was made is sound where it is copied to.
    assert main(["leaderboard", "check", "--entries", str(entries)]) == 0


def test_predictions_that_are_not_the_result_s_are_refused(run: Path, tmp_path, capsys) -> None:
    place = next((run / "captures" / "capture4" / "predictions").glob("*.png"))
    write_image(place, np.zeros((112, 112, 3), np.uint8))
    assert submit(run, tmp_path / "out") == 1
    assert "not the predictions that the result was scored from" in capsys.readouterr().err
    assert not (tmp_path / "out").exists()
    # Without any predictions the row can be submitted, and says so.
    for file in (run / "captures").rglob("*.png"):
        file.unlink()
    for name in ("capture0", "capture4"):
        (run / "captures" / name / "predictions").rmdir()
    assert submit(run, tmp_path / "out") == 0
    assert "predictions of 2 of 2 captures not at hand" in capsys.readouterr().err


def test_a_correction_is_a_revision(run: Path, tmp_path: Path, capsys) -> None:
    entries, out = tmp_path / "entries", tmp_path / "out"
    assert main(["dev", "leaderboard", "add", str(run), "--entries", str(entries)]) == 0
    (first,) = read_entries(entries)
    assert submit(run, out, entries=entries) == 2
    assert "is on the leaderboard already" in capsys.readouterr().err
    options = ["--revises", first.name, "--reason", "the link was missing"]
    assert submit(run, out, *options, entries=entries) == 0
    assert submit(run, tmp_path / "more", *options, "--author", "B", entries=tmp_path) == 2
    assert "which is not there" in capsys.readouterr().err
    (made,) = (out / "leaderboard" / "entries").glob("*.json")
    made.rename(entries / made.name)
    check = ["leaderboard", "check", "--entries", str(entries), "--against"]
    base = tmp_path / "base"
    base.mkdir()
    kept = base / f"{first.name}.json"
    kept.write_bytes((entries / kept.name).read_bytes())
    capsys.readouterr()
    assert main([*check, str(base)]) == 0
    assert capsys.readouterr().out == "2 entries, all sound, 1 new files\n"
    kept.write_text("{}")
    assert main([*check, str(base)]) == 1
    assert "was changed" in capsys.readouterr().err
    kept.rename(base / "gone.json")
    assert main([*check, str(base)]) == 1
    assert "was removed" in capsys.readouterr().err
    assert main([*check, str(tmp_path / "nowhere")]) == 2


@pytest.mark.parametrize(
    ("options", "status", "problem"),
    [
        (["--link", "code"], 2, "KIND=URL"),
        (["--link", "code=http://a.b"], 2, "https://"),
        (["--reason", "because"], 2, "a reason a revision"),
        (["--avatars", "{tmp}/run/captures"], 0, ""),
        (["--avatars", "{tmp}/run"], 1, "holds no avatar of the capture"),
        (["-o", "{tmp}/run"], 2, "is the input RESULTS too"),
        (["-o", "{tmp}/lib/site-packages/x"], 2, "installed package"),
    ],
)
def test_mistakes_are_named(run, tmp_path, capsys, options, status, problem) -> None:
    told = [text.replace("{tmp}", str(tmp_path)) for text in options]
    assert submit(run, tmp_path / "out", *told) == status
    assert problem in capsys.readouterr().err


def test_results_that_cannot_be_ranked_are_not_submitted(run: Path, tmp_path, capsys) -> None:
    whole = complete_results("mine")
    for changes, status, problem in (
        ({"captures": whole.captures[:1]}, 1, "lacks 1 of 2 captures"),
        ({"protocols": {"hwp-v0": {}}}, 2, "other protocols"),
        ({"suite": "captures"}, 2, "no suite that everybody has"),
    ):
        write_results(run / "results.json", replace(whole, **changes))
        assert submit(run, tmp_path / "out") == status
        assert problem in capsys.readouterr().err


def test_a_result_that_declares_no_training_data_is_not_submitted(
    run: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """As that of a class that Python code evaluated."""
    source = write_method(complete_results, tmp_path / "class")
    training = read_manifest(source).training
    whole = read_results(run / "results.json")
    method = replace(whole.method, training=training)
    write_results(run / "results.json", replace(whole, method=method))
    assert submit(run, tmp_path / "out") == 2
    assert "does not say what its method was trained on" in capsys.readouterr().err


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
    words = [
        "dev",
        "leaderboard",
        "confirm",
        str(file),
        "--checked-by",
        "us",
        "--capture",
        str(capture),
    ]
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


@pytest.mark.parametrize("gone", ["capture", "predictions"])
def test_what_cannot_be_scored_again_makes_no_check(made, gone: str) -> None:
    file, capture = made
    entry = make_entry(read_results(file))
    if gone == "predictions":
        shutil.rmtree(file.parent / "captures" / "tiny" / "predictions")
    with pytest.raises(BadResult, match="cannot be scored again here"):
        confirm(entry, file, [] if gone == "capture" else [capture], by="us")


def test_a_second_run_reproduces_within_the_tolerance(made) -> None:
    file, capture = made
    again = read_results(file)
    before = "2020-01-01T00:00:00+00:00"
    for shift, verdict in ((0.0, "reproduces"), (0.09, "reproduces"), (-0.11, "differs")):
        entry = make_entry(moved(again, psnr=shift, started=before))
        check = confirm(entry, file, [capture], by="us")
        assert (check.kind, check.verdict, check.same_predictions) == ("re-run", verdict, 1)
        assert check.scores["psnr"] == pytest.approx(again.scores["psnr"])
        assert (check.rerun, check.tolerance) == (digest(again), 0.1)
    assert confirm(entry, file, [capture], by="us", tolerance=0.2).verdict == "reproduces"


def test_a_second_run_must_hold_itself_and_be_of_the_entry(made) -> None:
    file, capture = made
    again = read_results(file)
    entry = make_entry(replace(again, started="2020-01-01T00:00:00+00:00"))
    write_results(file, moved(again, psnr=0.01))
    with pytest.raises(BadResult, match="is not as it says"):
        confirm(entry, file, [capture], by="us")
    write_results(file, again)
    for changes in (
        {"seed": 5},
        {"budget": {"seconds": 1.0, "steps": None}},
        {"method": replace(again.method, digest="other")},
        {"captures": [replace(again.captures[0], digest="other")]},
    ):
        with pytest.raises(UsageError, match="no entry is of this result or run"):
            entry_of([make_entry(replace(entry.results, **changes))], again, None)
    twin = make_entry(replace(entry.results, started="2021-01-01T00:00:00+00:00"))
    with pytest.raises(UsageError, match="several entries fit"):
        entry_of([entry, twin], again, None)
    assert entry_of([entry, twin], again, twin.name) is twin
