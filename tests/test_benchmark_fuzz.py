"""The fuzzer finds what it is for; cheap commands hold. Oracle: programs with known ends."""

from __future__ import annotations

import os
import random
import signal
import sys
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
import pytest
from small_captures import CaptureMaker, results_example

from benchmarks.fuzz import TARGETS, Target, fuzz, refuse_empty
from benchmarks.fuzz_mutations import JSON_VALUES, mutate
from benchmarks.fuzz_worker import faults_of, run_forked
from hwp_bench.results import write_results

pytestmark = pytest.mark.skipif(not hasattr(os, "fork"), reason="needs fork")

Program = Callable[[Sequence[str]], int]


def _raise(words: Sequence[str]) -> int:
    raise ValueError("not a message")


def _say(words: Sequence[str]) -> int:
    print("\x1b[2J")
    return 0


def _kill(words: Sequence[str]) -> int:
    os.kill(os.getpid(), signal.SIGKILL)
    return 0


def _allocate(words: Sequence[str]) -> int:
    return len(bytearray(8 << 30)) and 0


def _half(words: Sequence[str]) -> int:
    Path("out").mkdir()
    Path("out/.partial").write_text("x")
    print("hwp-bench: error: no", file=sys.stderr)
    return 1


def _twice(words: Sequence[str]) -> int:
    print("hwp-bench: error: no\nhwp-bench: error: no", file=sys.stderr)
    return 2


def _nan(words: Sequence[str]) -> int:
    Path("made.json").write_text("{")
    return 0


def _honest(words: Sequence[str]) -> int:
    print("hwp-bench: error: x: is missing", file=sys.stderr)
    return 1


@pytest.mark.parametrize(
    ("program", "fault"),
    [
        (_raise, "a traceback: ValueError: not a message"),
        (_say, "control characters on standard output"),
        (_kill, "was killed"),
        (_allocate, "a traceback: MemoryError"),
        (_half, "failed and wrote out"),
        (_half, "left out/.partial behind"),
        (_twice, "2 messages"),
        (_nan, "not valid JSON"),
        (lambda words: 3, "ended with status 3"),
        (lambda words: 1, "failed without a word"),
        (_honest, ""),
        (lambda words: 0, ""),
    ],
)
def test_every_bad_end_is_named(program: Program, fault: str, tmp_path: Path) -> None:
    ended = run_forked(program, [], tmp_path)
    faults = faults_of(ended, tmp_path, frozenset(), [tmp_path / "out"])
    assert any(fault in found for found in faults) if fault else not faults


def test_mutations_change_files_and_repeat(tmp_path: Path) -> None:
    valid = tmp_path / "a.json"
    text = '{"a": [1, 2], "b": {"c": "d"}}'
    for seed in range(100):
        made = []
        for _ in range(2):
            valid.write_text(text)
            mutate(valid, random.Random(seed))
            made.append(valid.read_bytes())
        assert made[0] == made[1]
    # What no writer of JSON writes is among the values, as it is.
    assert {"NaN", "1e999", '"\\ud800"', '{"a":1,"a":2}'} <= {*JSON_VALUES}


def test_a_file_that_no_seed_has_is_named(tmp_path: Path) -> None:
    """Nothing would be changed, and the run would say that nothing was found."""
    target = Target(("hwp-bench", "table", "results"), ("results/*.json",))
    with pytest.raises(SystemExit, match=r"hwp-bench table: no seed fits results/\*\.json"):
        refuse_empty([target], tmp_path)


def test_a_short_run_of_cheap_commands_finds_nothing(
    make_capture: CaptureMaker, tmp_path: Path
) -> None:
    seeds = tmp_path / "seeds"
    seeds.mkdir()
    make_capture().root.rename(seeds / "capture")
    write_results(seeds / "results", results_example())
    np.savez(seeds / "landmarks.npz", image=np.zeros((3, 21, 2)))
    cheap = {("data", "check"), ("data", "show"), ("table", "results"), ("data", "export")}
    chosen = [target for target in TARGETS if target.words[1:3] in cheap]
    assert len(chosen) >= 4
    tally = fuzz(chosen, seeds, tmp_path / "found", seed=7, cases=30)
    assert sum(tally.commands.values()) == 30
    assert set(tally.statuses) <= {0, 1, 2}
    assert not tally.found
