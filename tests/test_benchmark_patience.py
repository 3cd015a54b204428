"""Waits by what a process does. Oracles: clocks and counts that are given; two small programs."""

from __future__ import annotations

import contextlib
import os
import signal
import subprocess
import sys

import pytest

from benchmarks.patience import Patience, Stuck, finish, run


def test_slow_work_is_waited_for_and_none_is_not() -> None:
    """A tick of the processor every 100 s is a busy machine; none for 120 s is the end."""
    now = {"clock": 0.0, "spent": 5.0}
    patience = Patience(lambda: now["spent"], idle=120.0, clock=lambda: now["clock"])
    for _ in range(50):
        now["clock"] += 100.0
        now["spent"] += 0.01
        patience.check()
    now["clock"] += 119.0
    patience.check()
    now["clock"] += 2.0
    with pytest.raises(Stuck, match="has not used the processor for 120 s"):
        patience.check()


def test_work_without_an_end_is_stopped_by_its_amount_not_by_the_clock() -> None:
    now = {"clock": 0.0, "spent": 5.0}
    patience = Patience(lambda: now["spent"], most=60.0, clock=lambda: now["clock"])
    now["spent"] = 65.0
    patience.check()
    now["spent"] = 65.1
    with pytest.raises(Stuck, match="has not ended after 65 s of the processor"):
        patience.check()


@pytest.mark.parametrize(
    ("code", "limits", "said"),
    [
        ("import time; time.sleep(3600)", {"idle": 2.0}, "has not used the processor"),
        (
            "import subprocess, sys; subprocess.run([sys.executable, '-c', 'while True: pass'])",
            {"most": 1.0},
            "has not ended",
        ),
    ],
    ids=["sleeps", "its child runs for ever"],
)
def test_a_process_that_is_stuck_is_killed(code: str, limits: dict[str, float], said: str) -> None:
    # In a group of its own, so that the child does not outlive the test.
    wrapped = f"import os; os.setpgid(0, 0)\n{code}"
    with subprocess.Popen([sys.executable, "-c", wrapped]) as process:
        try:
            with pytest.raises(Stuck, match=said):
                finish(process, **limits)
        finally:
            with contextlib.suppress(ProcessLookupError):  # it was alone
                os.killpg(process.pid, signal.SIGKILL)
    assert process.returncode == -9


def test_what_ends_gives_its_status_and_words() -> None:
    code = "import sys; print('a' * 200_000); print('why', file=sys.stderr); sys.exit(3)"
    done = run([sys.executable, "-c", code])
    assert (done.returncode, len(done.stdout), done.stderr) == (3, 200_001, "why\n")
