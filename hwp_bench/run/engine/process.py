"""Run a job in a process of its own: watched, stopped with all that it started, its errors kept."""

from __future__ import annotations

import contextlib
import os
import pickle
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path

from hwp_bench.base.errors import BadInput, HwpError
from hwp_bench.base.files import read_json
from hwp_bench.base.packages import PACKAGES
from hwp_bench.run.engine.failures import parse_error
from hwp_bench.run.engine.job import Needs, Report, Work
from hwp_bench.run.engine.worker import FAILURE, GRACE_SECONDS, INTERRUPTED, PROGRESS

#: Variables that say how many threads a library starts.
THREADS = ("OMP_NUM_THREADS", "MKL_NUM_THREADS", "NUMBA_NUM_THREADS")

_POLL_SECONDS = 0.1


class WorkerLost(Exception):
    """The process of a job was killed by something outside the job."""


class Stopped(Exception):
    """The job was stopped because nobody wants it any more."""


@dataclass(frozen=True)
class Errand:
    """A job on the machine where it runs."""

    #: What to do.
    work: Work
    #: Where its inputs lie here.
    inputs: Mapping[str, Path]
    #: Folder of the result.
    output: Path
    #: Environment variables that it gets besides this process's.
    environment: Mapping[str, str]
    #: Folders that an orphan removes.
    scratch: tuple[Path, ...] = ()


def thread_environment(needs: Needs) -> dict[str, str]:
    """Return the variables that keep a job to its processors.

    What is set in this process's environment stays; so a person can choose other numbers.
    """
    threads = str(max(1, int(needs.cpus)))
    return {name: os.environ.get(name, threads) for name in THREADS}


def run_errand(errand: Errand, on_progress: Report, stop: Callable[[], bool]) -> None:
    """Run a job in a process and wait for it.

    Args:
        errand: the job.
        on_progress: called with (done, total) steps now and then.
        stop: says whether to give the job up.

    Raises:
        HwpError: the job's own error; or it broke, then with the last line that it printed.
        WorkerLost: the process was killed.
        Stopped: `stop` said so; the process and its children are gone.
    """
    with tempfile.TemporaryDirectory(prefix="hwp-job-") as name:
        messages = Path(name)
        with open(messages / "log.txt", "wb") as log:
            process = _start(errand, messages, log.fileno())
        try:
            while process.poll() is None:
                if stop():
                    raise Stopped
                _show(messages / PROGRESS, on_progress)
                with contextlib.suppress(subprocess.TimeoutExpired):
                    process.wait(_POLL_SECONDS)
        finally:
            _end(process)
        _raise_failure(process.returncode, messages)


def _start(errand: Errand, messages: Path, log: int) -> subprocess.Popen[bytes]:
    root = os.fspath(PACKAGES)
    known = os.environ.get("PYTHONPATH")
    environment = {
        **os.environ,
        **errand.environment,
        "PYTHONPATH": root if not known else os.pathsep.join([root, known]),
    }
    process = subprocess.Popen(
        [sys.executable, "-m", "hwp_bench.run.engine.worker"],
        stdin=subprocess.PIPE,
        stdout=log,
        stderr=log,
        env=environment,
        # Ctrl-C must reach it once, from us.
        start_new_session=True,
    )
    assert process.stdin is not None
    content = (
        errand.work,
        dict(errand.inputs),
        errand.output,
        messages,
        os.getpid(),
        [messages, *errand.scratch],
    )
    with contextlib.suppress(BrokenPipeError), process.stdin as stream:
        stream.write(pickle.dumps(content))
    return process


def _show(path: Path, on_progress: Report) -> None:
    if not path.is_file():
        return
    with contextlib.suppress(BadInput, TypeError, ValueError):
        done, total = read_json(path, max_bytes=1000)
        on_progress(int(done), int(total))


def _end(process: subprocess.Popen[bytes]) -> None:
    """Stop a process that still runs, kindly first, so that it stops what it started."""
    if process.poll() is None:
        process.terminate()
        deadline = time.monotonic() + GRACE_SECONDS
        while process.poll() is None and time.monotonic() < deadline:
            time.sleep(_POLL_SECONDS)
    with contextlib.suppress(ProcessLookupError, PermissionError):
        os.killpg(process.pid, signal.SIGKILL)
    process.wait()


def _raise_failure(status: int, messages: Path) -> None:
    if status == 0:
        return
    failure = messages / FAILURE
    if failure.is_file():
        raise parse_error(read_json(failure))
    if status < 0:
        raise WorkerLost(signal.Signals(-status).name)
    if status == INTERRUPTED:
        # By somebody else: whoever asks for a stop here does not come so far.
        raise WorkerLost("interrupted")
    lines = (messages / "log.txt").read_text(errors="replace").strip().splitlines()
    raise HwpError(f"a job broke: {lines[-1][:500] if lines else f'exit status {status}'}")
