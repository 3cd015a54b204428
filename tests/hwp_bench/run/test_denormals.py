"""Denormals are zero in every kind of process and thread. Oracle: a product that is denormal."""

from __future__ import annotations

import json
import subprocess
import sys
import threading
from pathlib import Path

import pytest
from denormal_probe import Probe
from small_methods import write_manifest

from hwp_bench.base.numerics import flushed, flushed_process, flushes, set_flush
from hwp_bench.methods.manifest import read_manifest
from hwp_bench.run.engine.processes import LocalJob, run_in_process
from hwp_bench.run.runner import run_method

TESTS = Path(__file__).parents[2]
#: A program of one command, as the two of ours are.
PROGRAM = (
    f"import sys; sys.path.insert(0, {str(TESTS)!r})\n"
    "from hwp_bench.cli.program import Command, run_program\n"
    "tree = Command('tests', commands={'probe': Command('probe', 'denormal_probe')})\n"
    "sys.exit(run_program('tests', tree, ['probe']))"
)
METHOD = f"""
import json, sys
sys.path.insert(0, {str(TESTS)!r})
import numpy as np
import denormal_probe

class Method:
    def __init__(self, settings, seed): self.states = denormal_probe.states()
    def fit(self, training, budget, report):
        report(0, self)
        return self
    def render(self, hands, camera):
        return np.zeros((camera.height, camera.width, 4), np.float32)
    def write_diagnostics(self, folder):
        folder.mkdir(parents=True)
        (folder / "states.json").write_text(json.dumps(self.states))
"""


def test_the_switch_goes_back() -> None:
    assert not flushes()
    with flushed():
        assert flushes()
        with flushed_process():
            assert flushes()
        assert flushes()
    assert not flushes()
    with pytest.raises(ValueError, match="inside"), flushed():
        raise ValueError("inside")
    assert not flushes()


def test_it_is_of_one_thread_and_those_that_it_starts() -> None:
    found: list[bool] = []
    with flushed():
        thread = threading.Thread(target=lambda: found.append(flushes()))
        thread.start()
        thread.join()
    thread = threading.Thread(target=lambda: found.extend((set_flush(True), flushes())))
    thread.start()
    thread.join()
    assert found == [True, False, True]
    assert not flushes()


def test_a_process_that_nobody_switched_computes_with_denormals() -> None:
    """The probe sees them, so that the tests below can fail."""
    script = f"import sys; sys.path.insert(0, {str(TESTS)!r})\n"
    script += "import denormal_probe; denormal_probe.run(None)"
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, check=True)
    found = json.loads(done.stdout)
    assert not any(found.values()), found


def test_a_command_flushes() -> None:
    done = subprocess.run([sys.executable, "-c", PROGRAM], capture_output=True, check=True)
    found = json.loads(done.stdout)
    assert all(found.values()), found
    assert b"subnormal" not in done.stderr


def test_the_process_of_a_job_flushes(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Parallel evaluations, rendering processes, and jobs on nodes of Ray are such processes."""
    monkeypatch.setenv("PYTHONPATH", str(TESTS))
    job = LocalJob(Probe(), {}, tmp_path / "out", {})
    run_in_process(job, lambda done, total: None, lambda: False)
    found = json.loads((tmp_path / "out" / "states.json").read_text())
    assert all(found.values()), found


def test_the_process_of_a_method_flushes(request_folder: Path, tmp_path: Path) -> None:
    folder = tmp_path / "method"
    folder.mkdir()
    (folder / "probing.py").write_text(METHOD)
    (folder / "denormal_probe.py").write_text((TESTS / "denormal_probe.py").read_text())
    write_manifest(folder, "probe", 'python = "probing:Method"')
    run_method(read_manifest(folder), "tiny", request_folder, tmp_path / "out")
    written = next((tmp_path / "out").rglob("states.json"))
    found = json.loads(written.read_text())
    assert all(found.values()), found


def test_this_process_was_left_alone() -> None:
    assert not flushes()
