"""Killed at random moments and started again. Oracle: the run that was left in peace.

`python -m benchmarks.faults` does the same 200 times; docs/threat-model.md has what it printed.
"""

from __future__ import annotations

import random
from pathlib import Path

import pytest

from benchmarks.faults import Target, make_targets, torture

#: Kills of each command here.
KILLS = 2


@pytest.fixture(scope="module")
def targets(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Target]:
    return {target.name: target for target in make_targets(tmp_path_factory.mktemp("faults"))}


@pytest.mark.slow
@pytest.mark.parametrize("name", ["sim render", "evaluate", "ablate", "wildghand fit"])
def test_a_killed_run_ends_as_one_left_in_peace(
    targets: dict[str, Target], tmp_path: Path, name: str
) -> None:
    tally = torture(targets[name], KILLS, tmp_path, random.Random(name))
    assert tally.faults == ()
    assert tally.kills >= KILLS
    assert tally.finished >= 1


def test_another_result_is_noticed(tmp_path: Path) -> None:
    # A command whose result depends on how often it was started.
    script = (
        "import pathlib, sys, time; p = pathlib.Path(sys.argv[1]); p.mkdir(exist_ok=True); "
        "(p / str(time.time_ns())).touch(); time.sleep(1); (p / 'done').touch()"
    )
    target = Target(
        "restless",
        lambda out: ["-c", script, str(out)],
        lambda out: str(len(list(out.iterdir()))),
        False,
    )
    # Late enough that the first start has left its mark.
    chance = random.Random(0)
    chance.uniform = lambda low, high: 0.7 * high  # type: ignore[method-assign]
    assert torture(target, 1, tmp_path, chance).faults == ("after kill 1: another result",)
