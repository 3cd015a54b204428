"""Killed at random moments and started again. Oracle: the run that was left in peace.

`python -m benchmarks.faults` does the same 200 times; docs/threat-model.md has what it printed.
`sim render` is killed in `test_sim_bad_input.py`.
"""

from __future__ import annotations

import random
import subprocess
import sys
import time
from collections.abc import Sequence
from pathlib import Path

import pytest

from benchmarks.faults import Target, make_targets, torture

#: Kills of each command here.
KILLS = 2


@pytest.fixture(scope="module")
def targets(tmp_path_factory: pytest.TempPathFactory, machine_code: None) -> dict[str, Target]:
    # One seed: an ablation of two evaluations, between which it can be killed.
    made = make_targets(tmp_path_factory.mktemp("faults"), seeds=1)
    return {target.name: target for target in made}


@pytest.mark.slow
@pytest.mark.parametrize("name", ["evaluate", "ablate", "wildghand fit"])
def test_a_killed_run_ends_as_one_left_in_peace(
    targets: dict[str, Target], tmp_path: Path, name: str
) -> None:
    tally = torture(targets[name], KILLS, tmp_path, random.Random(name))
    assert tally.faults == ()
    assert tally.kills >= KILLS
    assert tally.finished >= 1


def test_another_result_is_noticed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    # A command whose result depends on how often it was started, and that waits to be killed.
    script = (
        "import pathlib, sys, time; p = pathlib.Path(sys.argv[1]); p.mkdir(exist_ok=True); "
        "first = not any(p.iterdir()); (p / str(time.time_ns())).touch(); "
        "first and p.name != 'peace' and time.sleep(600)"
    )

    def kill(words: Sequence[str], moment: float) -> int:
        out = Path(words[-1])
        with subprocess.Popen([sys.executable, *words]) as process:
            while not (out.is_dir() and any(out.iterdir())):
                time.sleep(0.01)
            process.kill()
        return 1

    monkeypatch.setattr("benchmarks.faults._kill", kill)
    target = Target(
        "restless",
        lambda out: ["-c", script, str(out)],
        lambda out: str(len(list(out.iterdir()))),
        False,
    )
    tally = torture(target, 1, tmp_path, random.Random(0))
    assert tally.faults == ("after kill 1: another result",)
