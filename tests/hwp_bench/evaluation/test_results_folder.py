"""Results that an evaluation may not lose. Oracles: the files of before, `verify`, a count of fits.

A method draws one level of gray and notes each fit in a file next to its folder.
"""

from __future__ import annotations

import os
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import pytest
from small_captures import CaptureMaker
from small_methods import SCRIPT, write_manifest

from benchmarks.patience import Patience, spent_by
from hwp_bench.base.errors import BadMethod, UsageError
from hwp_bench.capture import Capture
from hwp_bench.cli.main import main
from hwp_bench.evaluation.capture_evaluation import EvaluationSettings
from hwp_bench.evaluation.evaluate import evaluate
from hwp_bench.evaluation.verify import verify_results
from hwp_bench.methods.contract import Budget, RunSettings
from hwp_bench.results import Results, read_results, write_results
from hwp_bench.run.engine import Job
from hwp_bench.run.engine.job import LocalEngine, OnDone, OnStart
from hwp_bench.run.sandbox.confinement import Confinement

SETTINGS = EvaluationSettings(confinement=Confinement("none"))
_SCRIPT = """
import json, pathlib, sys, time
import cv2, numpy as np
request, output = map(pathlib.Path, sys.argv[1:])
here = pathlib.Path(__file__).parent
value = json.loads((request / "request.json").read_text())
with open(here.parent / "fits.log", "a") as stream:
    stream.write(f"{value['id']} {value['seed']}\\n")
if value["settings"].get("fail") == value["id"]:
    sys.exit("no luck")
while value["settings"].get("wait") == value["id"] and not (here.parent / "go").exists():
    time.sleep(0.05)
if value["settings"].get("litter"):
    (here / "notes.txt").write_text("made while it ran")
(output / "predictions").mkdir()
for frame in range(*value["split"]["test"]):
    level = np.full((value["height"], value["width"], 3), 90 + value["seed"], np.uint8)
    cv2.imwrite(str(output / "predictions" / f"{frame:06d}.png"), level)
"""


@pytest.fixture
def method(tmp_path: Path) -> Path:
    folder = tmp_path / "gray"
    folder.mkdir()
    (folder / "run.py").write_text(_SCRIPT)
    write_manifest(folder, "gray", SCRIPT)
    return folder


@pytest.fixture
def captures(make_capture: CaptureMaker) -> list[Capture]:
    return [make_capture(name, frames=20, size=32, truth=True) for name in ("first", "second")]


def run(
    method: Path,
    captures: Sequence[Capture],
    out: Path,
    *,
    seed: int = 0,
    steps: int | None = None,
    overwrite: bool = False,
    **settings: object,
) -> Results:
    chosen = replace(SETTINGS, run=RunSettings(settings, seed, Budget(None, steps)))
    folders = [capture.root for capture in captures]
    return evaluate(str(method), folders, out, chosen, overwrite=overwrite)


def fits(method: Path) -> list[str]:
    file = method.parent / "fits.log"
    return file.read_text().splitlines() if file.is_file() else []


def tree(folder: Path) -> dict[str, bytes]:
    files = (path for path in folder.rglob("*") if path.is_file())
    return {str(path.relative_to(folder)): path.read_bytes() for path in files}


def holds(out: Path, captures: Sequence[Capture]) -> bool:
    return not verify_results(out, [capture.root for capture in captures]).discrepancies


@pytest.mark.parametrize(
    ("change", "problem"),
    [
        ({"seed": 1}, "seed 0, now 1"),
        ({"steps": 9}, "steps none, now 9"),
        ({"many": "lots"}, "setting many default, now lots"),
    ],
)
def test_results_of_other_arguments_are_refused_with_what_differs(
    method, captures, tmp_path: Path, change: dict[str, object], problem: str
) -> None:
    out = tmp_path / "out"
    run(method, captures, out)
    before = tree(out)
    with pytest.raises(UsageError, match=f"results of another evaluation: {problem}.*--overwrite"):
        run(method, captures, out, **change)  # type: ignore[arg-type]
    assert tree(out) == before
    assert len(fits(method)) == 2


def test_results_of_another_method_or_other_data_are_refused(
    method, captures, make_capture: CaptureMaker, tmp_path: Path
) -> None:
    out = tmp_path / "out"
    run(method, captures, out)
    before = tree(out)
    other = shutil.copytree(method, tmp_path / "other")
    (other / "method.toml").write_text(
        (method / "method.toml").read_text().replace('"gray"', '"grey"')
    )
    with pytest.raises(UsageError, match="method gray, now grey"):
        run(other, captures, out)
    with pytest.raises(UsageError, match="data: it is of second too"):
        run(method, captures[:1], out)
    changed = make_capture("second", frames=30, folder=tmp_path / "changed")
    with pytest.raises(UsageError, match="second: data: it has changed"):
        run(method, [captures[0], changed], out)
    (method / "run.sh").write_text("# one more file")
    with pytest.raises(UsageError, match="the method's files have changed"):
        run(method, captures, out)
    assert tree(out) == before


def test_a_call_that_runs_nothing_leaves_the_record_as_it_was(
    method, captures, tmp_path: Path
) -> None:
    # A second call on another day and machine would pass for a second run.
    out = tmp_path / "out"
    first = run(method, captures, out)
    elsewhere = {**first.environment, "processor": "another"}
    before = replace(first, started="2026-01-01T00:00:00+00:00", environment=elsewhere)
    write_results(out / "results.json", before)
    assert run(method, captures, out) == before == read_results(out)
    assert len(fits(method)) == 2


def test_the_same_call_keeps_what_is_there_and_says_so(
    method, captures, tmp_path: Path, capsys
) -> None:
    out = tmp_path / "out"
    words = ["evaluate", str(method), "-o", str(out), "--isolation", "none", "--capture"]
    assert main([*words, str(captures[0].root)]) == 0
    assert "kept" not in capsys.readouterr().err
    before = (out / "captures" / "first" / "result.json").read_bytes()
    both = [str(capture.root) for capture in captures]
    assert main([*words, *both]) == 0
    assert "differs: first (1 of 2 were there)" in capsys.readouterr().err
    assert main([*words, *both]) == 0
    shown = capsys.readouterr()
    assert "differs: first, second (complete)" in shown.err
    assert fits(method) == ["first 0", "second 0"]
    assert (out / "captures" / "first" / "result.json").read_bytes() == before


def test_an_overwrite_that_is_stopped_leaves_the_old_results_whole(
    method, captures, tmp_path: Path
) -> None:
    """Ctrl-C while the second capture of the new evaluation runs, and then the same call again."""
    out = tmp_path / "out"
    run(method, captures, out)
    for name in ("captures/first/notes.txt", "captures/second/pictures/mine.png", "todo.txt"):
        (out / name).write_text("mine")
    before = tree(out)
    words = [sys.executable, "-m", "hwp_bench.cli.main", "evaluate", str(method), "-o", str(out)]
    words += ["--isolation", "none", "--seed", "1", "--set", "wait=second", "--overwrite"]
    words += ["--capture", *(str(capture.root) for capture in captures)]
    process = subprocess.Popen(
        words,
        stderr=subprocess.PIPE,
        text=True,
        # Where the tests run in the background, a child would ignore the signal as they do.
        preexec_fn=lambda: signal.signal(signal.SIGINT, signal.SIG_DFL),
    )
    patience = Patience(spent_by(process.pid))
    while "second 1" not in fits(method):
        assert process.poll() is None, process.communicate()
        patience.check()
        time.sleep(0.05)
    process.send_signal(signal.SIGINT)
    _, said = process.communicate()
    assert process.returncode == 130, said
    left = tree(out)
    assert {name: left[name] for name in before} == before
    assert holds(out, captures)
    (tmp_path / "go").touch()
    done = subprocess.run(words, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    # What the stopped one had finished was not run again.
    assert fits(method) == ["first 0", "second 0", "first 1", "second 1", "second 1"]
    after = tree(out)
    assert {after[name] for name in after if name.endswith(("notes.txt", "mine.png"))} == {b"mine"}
    assert after["todo.txt"] == b"mine"
    assert after["captures/first/result.json"] != before["captures/first/result.json"]
    assert not [name for name in after if ".unfinished" in name]
    assert holds(out, captures)


class _Stopped(LocalEngine):
    """Is stopped after some jobs."""

    def __init__(self, after: int) -> None:
        self._after = after

    def run(self, jobs: Sequence[Job], on_done: OnDone, on_start: OnStart | None = None) -> None:
        super().run(jobs[: self._after], on_done, on_start)
        raise KeyboardInterrupt


def test_a_fresh_evaluation_that_is_stopped_goes_on(method, captures, tmp_path: Path) -> None:
    out, folders = tmp_path / "out", [capture.root for capture in captures]
    with pytest.raises(KeyboardInterrupt):
        evaluate(str(method), folders, out, SETTINGS, engine=_Stopped(1))
    assert (out / "captures" / "first" / "result.json").is_file()
    assert not (out / "results.json").exists()
    # Nor may another evaluation take what is finished of it.
    with pytest.raises(UsageError, match="first: method, settings, seed, budget"):
        run(method, captures, out, seed=1)
    run(method, captures, out)
    assert fits(method) == ["first 0", "second 0"]
    assert holds(out, captures)


def test_captures_that_failed_are_no_results_that_could_be_lost(
    method, captures, tmp_path: Path
) -> None:
    out = tmp_path / "out"
    results = run(method, captures[:1], out, fail="first")
    assert results.captures[0].failure is not None
    assert "it printed last: no luck" in results.captures[0].failure
    own = out / "captures" / "first" / "mine" / "notes.txt"
    own.parent.mkdir()
    own.write_text("mine")
    again = run(method, captures[:1], out)
    assert again.captures[0].failure is None
    assert own.read_text() == "mine"
    assert not (out / "captures" / "first" / "warnings.json").exists()
    assert holds(out, captures[:1])


def test_what_is_left_out_of_new_results_goes_but_for_own_files(
    method, captures, tmp_path: Path
) -> None:
    out = tmp_path / "out"
    run(method, captures, out)
    (out / "captures" / "second" / "notes.txt").write_text("mine")
    run(method, captures[:1], out, overwrite=True)
    assert [path.name for path in (out / "captures" / "second").iterdir()] == ["notes.txt"]
    assert sorted(path.name for path in (out / "captures").iterdir()) == ["first", "second"]
    assert holds(out, captures[:1])


def test_a_process_that_was_killed_between_two_places_loses_nothing(
    method, captures, tmp_path: Path
) -> None:
    out = tmp_path / "out"
    run(method, captures, out)
    before = tree(out)
    # Killed when the old folder had given its name up, and the new one had not taken it.
    os.rename(out / "captures" / "first", out / "captures" / ".first.0123456789ab")
    run(method, captures, out)
    assert tree(out / "captures") == {
        name.removeprefix("captures/"): content
        for name, content in before.items()
        if name.startswith("captures/")
    }
    assert len(fits(method)) == 2
    # Killed in the middle of a replacement: its record was written, one capture had its place.
    new = tmp_path / "new"
    run(method, captures, new, seed=1)
    shutil.rmtree(out / "captures" / "first")
    shutil.copytree(new / "captures" / "first", out / "captures" / "first")
    unfinished = out / "captures" / ".unfinished"
    shutil.copytree(new / "captures" / "second", unfinished / "second")
    shutil.copy(new / "results.json", unfinished)
    run(method, captures, out, seed=1)
    assert len(fits(method)) == 4
    assert holds(out, captures)
    assert not unfinished.exists()


def test_a_method_whose_files_change_while_it_runs_is_not_scored(
    method, captures, tmp_path: Path
) -> None:
    with pytest.raises(BadMethod, match=r"files changed while it ran.*: notes\.txt"):
        run(method, captures, tmp_path / "out", litter=True)
    assert not (tmp_path / "out" / "captures" / "first").exists()


def test_ablations_keep_results_of_other_settings_too(
    method, captures, tmp_path: Path, capsys
) -> None:
    with open(method / "method.toml", "a") as stream:
        stream.write("[presets.default]\na = true\n[switches.a]\nsettings_off = {a = false}\n")
    out = tmp_path / "out"
    words = ["ablate", str(method), "-o", str(out), "--isolation", "none", "--seeds", "1"]
    words += ["--capture", str(captures[0].root)]
    assert main(words) == 0
    before = tree(out)
    assert main([*words, "--steps", "9"]) == 2
    assert "steps none, now 9" in capsys.readouterr().err
    assert tree(out) == before
    assert len(fits(method)) == 2
    assert main([*words, "--steps", "9", "--overwrite"]) == 0
    assert len(fits(method)) == 4
    for variant in ("full", "no-a"):
        assert holds(out / "variants" / variant / "seed-0", captures[:1])
