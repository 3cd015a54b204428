"""How threads wait and how many there are, in every kind of process of ours.

Oracles: the environment that a process finds when its work is imported, and what GNU's OpenMP says
of itself when torch loads it. No time is measured.
"""

from __future__ import annotations

import json
import os
import re
import subprocess
import sys
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pytest
from small_methods import write_manifest

from hwp_bench.base import numerics as threads
from hwp_bench.base.errors import UsageError
from hwp_bench.cli import program
from hwp_bench.cli.program import Command, run_program
from hwp_bench.methods.manifest import read_manifest
from hwp_bench.run.engine.processes import LocalJob, run_in_process
from hwp_bench.run.runner import run_method

TESTS = Path(__file__).parents[2]
#: Everything that says something of threads.
NAMES = (
    *threads.OPENMP_WAITING,
    *threads.OPENCV_WAITING,
    *threads.TORCH_COUNTS,
    *threads.BLAS_COUNTS,
    "NUMBA_NUM_THREADS",
)
#: What a process of ours finds where a person has set nothing.
OURS = {
    "OMP_WAIT_POLICY": "PASSIVE",
    "OPENCV_THREAD_POOL_ACTIVE_WAIT_MAIN": "0",
    "OPENCV_THREAD_POOL_ACTIVE_WAIT_WORKER": "0",
    "OPENBLAS_NUM_THREADS": "1",
}
METHOD = f"""
import json, os
FOUND = {{name: os.environ[name] for name in {NAMES!r} if name in os.environ}}
import numpy as np

class Method:
    def __init__(self, settings, seed): pass
    def fit(self, training, budget, report):
        report(0, self)
        return self
    def render(self, hands, camera):
        return np.zeros((camera.height, camera.width, 4), np.float32)
    def write_diagnostics(self, folder):
        folder.mkdir(parents=True)
        (folder / "found.json").write_text(json.dumps(FOUND))
"""


def found_here() -> dict[str, str]:
    return {name: os.environ[name] for name in NAMES if name in os.environ}


@dataclass(frozen=True)
class Look:
    """A job that writes down what its process finds."""

    def __call__(self, inputs: Mapping[str, Path], output: Path, on_progress: Any) -> None:
        output.mkdir()
        (output / "found.json").write_text(json.dumps(found_here()))


@pytest.fixture(autouse=True)
def _nothing_set(monkeypatch: pytest.MonkeyPatch) -> None:
    """As in a shell of somebody who set nothing; a process that we start must see to it itself."""
    for name in NAMES:
        # Put back at the end, also where there was none.
        monkeypatch.setenv(name, "")
        monkeypatch.delenv(name)


#: Loads torch's own OpenMP, as torch does, without the rest of it.
LOAD = """
import ctypes, importlib.util, pathlib
folder = pathlib.Path(importlib.util.find_spec("torch").origin).parent / "lib"
for path in folder.glob("libgomp*"):
    ctypes.CDLL(str(path))
"""


def turns_of_spinning(script: str, **variables: str) -> str:
    """What GNU's OpenMP says of itself in a process: how often a thread looks before it sleeps."""
    environment = {**os.environ, **variables, "OMP_DISPLAY_ENV": "VERBOSE"}
    words = [sys.executable, "-c", script + LOAD]
    done = subprocess.run(
        words, env=environment, cwd=TESTS.parent, capture_output=True, text=True, check=True
    )
    found = re.findall(r"GOMP_SPINCOUNT = '(.*)'", done.stderr)
    return found[0] if found else ""


@pytest.mark.parametrize("module", ["hwp_bench", "wildghand.cli.main", "benchmarks"])
def test_torch_is_loaded_with_threads_that_sleep(module: str) -> None:
    """Programs, the Python API, ranks of `torchrun` and benchmarks import one of these first."""
    script = f"import sys, {module}; assert 'torch' not in sys.modules"
    if alone := turns_of_spinning(""):  # torch's OpenMP is GNU's
        assert int(alone) > 1000
        assert turns_of_spinning(script) == "0"
        assert turns_of_spinning(script, OMP_WAIT_POLICY="ACTIVE") not in ("0", alone)
        assert turns_of_spinning(script, GOMP_SPINCOUNT="77") == "77"


@pytest.mark.parametrize(
    ("chosen", "expected"),
    [
        ({}, OURS),
        ({"OMP_WAIT_POLICY": "ACTIVE"}, {**OURS, "OMP_WAIT_POLICY": "ACTIVE"}),
        ({"OPENBLAS_NUM_THREADS": "3"}, {**OURS, "OPENBLAS_NUM_THREADS": "3"}),
    ],
)
def test_the_process_of_a_job_finds_what_is_ours_or_was_chosen(
    chosen: dict[str, str],
    expected: dict[str, str],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Parallel evaluations, rendering, and jobs on nodes of Ray are such processes."""
    monkeypatch.setenv("PYTHONPATH", os.pathsep.join([str(TESTS), str(Path(__file__).parent)]))
    for name, value in chosen.items():
        monkeypatch.setenv(name, value)
    run_in_process(LocalJob(Look(), {}, tmp_path / "out", {}), lambda *_: None, lambda: False)
    assert json.loads((tmp_path / "out" / "found.json").read_text()) == expected


@pytest.mark.parametrize(
    ("chosen", "expected"),
    [
        ({}, OURS),
        (
            {"GOMP_SPINCOUNT": "9", "OMP_NUM_THREADS": "2", "NUMBA_NUM_THREADS": "3"},
            {
                **{name: OURS[name] for name in threads.OPENCV_WAITING},
                "GOMP_SPINCOUNT": "9",
                "OMP_NUM_THREADS": "2",
                "NUMBA_NUM_THREADS": "3",
            },
        ),
    ],
)
def test_the_process_of_a_method_finds_what_is_ours_or_was_chosen(
    chosen: dict[str, str],
    expected: dict[str, str],
    request_folder: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    for name, value in chosen.items():
        monkeypatch.setenv(name, value)
    folder = tmp_path / "method"
    folder.mkdir()
    (folder / "looking.py").write_text(METHOD)
    write_manifest(folder, "look", 'python = "looking:Method"')
    run_method(read_manifest(folder), "tiny", request_folder, tmp_path / "out")
    written = next((tmp_path / "out").rglob("found.json"))
    assert json.loads(written.read_text()) == expected


def test_a_method_that_is_a_command_inherits_what_is_ours(
    request_folder: Path, tmp_path: Path
) -> None:
    threads.wait_passively()  # as importing `hwp_bench` did in this process
    folder = tmp_path / "method"
    folder.mkdir()
    (folder / "look.py").write_text("import os; print(sorted(os.environ.items()))")
    write_manifest(folder, "look", 'command = ["{python}", "{method}/look.py"]')
    run_method(read_manifest(folder), "tiny", request_folder, tmp_path / "out")
    printed = (tmp_path / "out" / "log.txt").read_text()
    for name in ("OMP_WAIT_POLICY", *threads.OPENCV_WAITING):
        assert repr((name, OURS[name])) in printed


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("NUMBA_NUM_THREADS", "0"),
        ("NUMBA_NUM_THREADS", "x"),
        ("OMP_NUM_THREADS", "0"),
        ("OMP_NUM_THREADS", "-3"),
        ("OMP_NUM_THREADS", "2,x"),
        ("OMP_NUM_THREADS", "100000"),
        ("MKL_NUM_THREADS", "1.5"),
        ("OPENBLAS_NUM_THREADS", "many"),
        ("GOTO_NUM_THREADS", "0"),
        ("OMP_WAIT_POLICY", "sleepy"),
    ],
)
def test_a_wrong_variable_is_one_line(
    name: str, value: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setenv(name, value)
    with pytest.raises(UsageError, match=f"^{name}: is {value!r}"):
        threads.check_thread_variables(os.environ)
    tree = Command("tests", commands={"look": Command("look", "nothing")})
    assert run_program("tests", tree, ["look"]) == 2
    said = capsys.readouterr().err
    assert said.startswith(f"tests: error: {name}: is {value!r}, ")
    assert said.count("\n") == 1


@pytest.mark.parametrize("value", ["1", "4", "2,1", " 3 ", ""])
def test_a_sound_number_is_taken(value: str) -> None:
    threads.check_thread_variables({"OMP_NUM_THREADS": value, "OMP_WAIT_POLICY": "Active"})


@pytest.mark.parametrize(
    ("error", "expected"),
    [
        (RuntimeError("can't start new thread"), "ulimit -u"),
        (BlockingIOError(11, "Resource temporarily unavailable"), "ulimit -u"),
        (OSError(24, "Too many open files"), "ulimit -n"),
        (OSError(28, "No space left on device"), "Make room"),
    ],
)
def test_what_the_system_refuses_is_one_line_with_a_remedy(
    error: Exception,
    expected: str,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    def refuse(*_: object) -> int:
        raise error

    monkeypatch.setattr(program, "_dispatch", refuse)
    assert run_program("tests", Command("tests"), []) == 1
    said = capsys.readouterr().err
    assert expected in said
    assert said.count("\n") == 1


def test_another_runtime_error_is_not_hidden(monkeypatch: pytest.MonkeyPatch) -> None:
    def broken(*_: object) -> int:
        raise RuntimeError("a bug")

    monkeypatch.setattr(program, "_dispatch", broken)
    with pytest.raises(RuntimeError, match="a bug"):
        run_program("tests", Command("tests"), [])


def test_no_pipe_of_a_run_is_left_open(tmp_path: Path) -> None:
    script = (
        "import gc, pathlib\n"
        "from hwp_bench.run.sandbox.supervise import Limits, Program, run_confined\n"
        f"folder = pathlib.Path({str(tmp_path)!r})\n"
        "program = Program(['/bin/true'], folder, {}, None, folder / 'log.txt')\n"
        "print(run_confined(program, Limits(60.0, 10**10)).status)\n"
        "gc.collect()\n"
    )
    words = [sys.executable, "-W", "error::ResourceWarning", "-c", script]
    done = subprocess.run(words, capture_output=True, text=True, check=True)
    assert done.stdout == "0\n"
    assert "ResourceWarning" not in done.stderr
