"""Run a job in a process of its own, which ends with all that it started.

`run_in_process` starts the process, watches it, and raises the job's error. `main` is what runs
inside it; it ends, with every process of its own, when whoever started it is gone.
"""

from __future__ import annotations

import contextlib
import os
import pickle
import shutil
import signal
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from hwp_bench.base import errors
from hwp_bench.base.errors import BadInput, HwpError
from hwp_bench.base.files import read_json, write_json
from hwp_bench.base.packages import PACKAGES
from hwp_bench.run.engine.job import Needs, OnProgress, Work

#: Variables that say how many threads a library starts.
THREADS = ("OMP_NUM_THREADS", "MKL_NUM_THREADS", "NUMBA_NUM_THREADS")
#: Variable that says which GPUs a process sees.
VISIBLE_GPUS = "CUDA_VISIBLE_DEVICES"
#: How far the job is, in the folder of the process's messages.
PROGRESS = "progress.json"
#: Why the job failed, in the same folder.
FAILURE = "failure.json"
#: Exit status of a job that was told to stop.
INTERRUPTED = 130
#: Seconds between two checks that the parent lives, and between two notes of progress.
LOOK_SECONDS = 0.5
#: Seconds that an orphan may take to end its own processes.
GRACE_SECONDS = 20.0

_POLL_SECONDS = 0.1
#: The module that is started, and the one whose `main` it runs.
_START = ("-m", "hwp_bench.run.start", "hwp_bench.run.engine.process")


class WorkerLost(Exception):
    """The process of a job was killed by something outside the job."""


class Stopped(Exception):
    """The job was stopped because its result is no longer needed."""


@dataclass(frozen=True)
class LocalJob:
    """A job on the machine where it runs."""

    #: The work.
    work: Work
    #: Where its inputs lie here.
    inputs: Mapping[str, Path]
    #: Folder of the result.
    output: Path
    #: Environment variables that it gets in addition to this process's.
    environment: Mapping[str, str]
    #: Folders that an orphan removes.
    scratch: tuple[Path, ...] = ()


def thread_environment(needs: Needs) -> dict[str, str]:
    """Return the variables that keep a job to its processors.

    Variables that are set already stay, so that a person can choose other numbers.
    """
    threads = str(max(1, int(needs.cpus)))
    return {name: os.environ.get(name, threads) for name in THREADS}


def run_in_process(job: LocalJob, on_progress: OnProgress, stop: Callable[[], bool]) -> None:
    """Run a job in a process and wait for it.

    Args:
        job: the job.
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
            process = _start(job, messages, log.fileno())
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


def _start(job: LocalJob, messages: Path, log: int) -> subprocess.Popen[bytes]:
    root = os.fspath(PACKAGES)
    known = os.environ.get("PYTHONPATH")
    environment = {
        **os.environ,
        **job.environment,
        "PYTHONPATH": root if not known else os.pathsep.join([root, known]),
    }
    process = subprocess.Popen(
        [sys.executable, *_START],
        stdin=subprocess.PIPE,
        stdout=log,
        stderr=log,
        env=environment,
        # Ctrl-C must reach it once, from us.
        start_new_session=True,
    )
    assert process.stdin is not None
    content = (
        job.work,
        dict(job.inputs),
        job.output,
        messages,
        os.getpid(),
        [messages, *job.scratch],
    )
    with contextlib.suppress(BrokenPipeError), process.stdin as stream:
        stream.write(pickle.dumps(content))
    return process


def _show(path: Path, on_progress: OnProgress) -> None:
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
        # By somebody else: a stop that was asked for here raises `Stopped` before this line.
        raise WorkerLost("interrupted")
    lines = (messages / "log.txt").read_text(errors="replace").strip().splitlines()
    raise HwpError(f"a job broke: {lines[-1][:500] if lines else f'exit status {status}'}")


def main() -> int:
    """Read one job from standard input and do it; returns the exit status."""
    signal.signal(signal.SIGTERM, signal.default_int_handler)
    # The job comes from our own parent process through a pipe.
    work, inputs, output, messages, parent, folders = pickle.load(sys.stdin.buffer)
    threading.Thread(target=_watch, args=(parent, folders), daemon=True).start()
    try:
        work(inputs, output, _Note(messages / PROGRESS, parent))
    except HwpError as error:
        write_json(messages / FAILURE, error_record(error))
        return 1
    except KeyboardInterrupt:
        return INTERRUPTED
    finally:
        if os.getppid() != parent:
            _remove(folders)
    return 0


class _Note:
    """Writes down how far the job is, not too often; an orphan is stopped at its next step."""

    def __init__(self, path: Path, parent: int) -> None:
        self._path = path
        self._parent = parent
        self._next = 0.0

    def __call__(self, done: int, total: int) -> None:
        if os.getppid() != self._parent:
            raise KeyboardInterrupt
        if (now := time.monotonic()) >= self._next:
            self._next = now + LOOK_SECONDS
            with contextlib.suppress(HwpError):
                write_json(self._path, [done, total])


def _watch(parent: int, folders: Sequence[Path]) -> None:
    while os.getppid() == parent:
        time.sleep(LOOK_SECONDS)
    # As by Ctrl-C, so that a method's processes are stopped and temporary files removed.
    os.kill(os.getpid(), signal.SIGINT)
    time.sleep(GRACE_SECONDS)
    _remove(folders)
    os._exit(1)


def _remove(folders: Sequence[Path]) -> None:
    for folder in folders:
        shutil.rmtree(folder, ignore_errors=True)


def error_record(error: HwpError) -> dict[str, str | None]:
    """Return an error as JSON, on its way to another process or node; `parse_error` reads it."""
    return {
        "kind": type(error).__name__,
        "problem": error.problem,
        "where": error.where,
        "field": error.field,
        "remedy": error.remedy,
    }


def parse_error(value: Mapping[str, str | None]) -> HwpError:
    """Return the error of an `error_record`."""
    kind = getattr(errors, str(value["kind"]), HwpError)
    if not (isinstance(kind, type) and issubclass(kind, HwpError)):
        kind = HwpError
    return kind(
        str(value["problem"]),
        where=value["where"],
        field=value["field"],
        remedy=value["remedy"],
    )
