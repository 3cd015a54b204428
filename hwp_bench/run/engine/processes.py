"""Jobs in processes of their own on this machine, several at once.

`run_in_process` starts a process, watches it, and raises the job's error. `main` is what runs
inside it; it ends, with every process of its own, when whoever started it is gone.
"""

from __future__ import annotations

import contextlib
import math
import os
import pickle
import queue
import shutil
import signal
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import FIRST_COMPLETED, ThreadPoolExecutor, wait
from dataclasses import dataclass
from pathlib import Path

from hwp_bench.base import errors
from hwp_bench.base.console import JobsView
from hwp_bench.base.errors import BadInput, HwpError, UsageError
from hwp_bench.base.files import read_json, write_json
from hwp_bench.base.packages import PACKAGES
from hwp_bench.run import START
from hwp_bench.run.engine.job import (
    Engine,
    Job,
    Needs,
    OnDone,
    OnProgress,
    OnStart,
    Work,
    raise_first,
)

#: Times that a job is started again after its worker was lost.
RETRIES = 3
#: Variables that say how many threads a library starts.
THREADS = ("OMP_NUM_THREADS", "MKL_NUM_THREADS", "NUMBA_NUM_THREADS")
#: Variable that says which GPUs a process sees.
VISIBLE_GPUS = "CUDA_VISIBLE_DEVICES"
# In the folder of the process's messages: how far the job is, why it failed, what it printed.
_PROGRESS, _FAILURE, _LOG = "progress.json", "failure.json", "log.txt"
# Exit status of a job that was told to stop.
_INTERRUPTED = 130
#: Seconds between two checks that the parent lives, and between two notes of progress.
LOOK_SECONDS = 0.5
#: Seconds that an orphan may take to end its own processes.
GRACE_SECONDS = 20.0
_POLL_SECONDS = 0.1


class ParallelEngine(Engine):
    """Runs up to `at_once` jobs at once; a job whose process is killed is started again."""

    def __init__(self, at_once: int, view: JobsView | None = None) -> None:
        self._at_once = at_once
        self._view = view or JobsView(quiet=True)

    def run(self, jobs: Sequence[Job], on_done: OnDone, on_start: OnStart | None = None) -> None:
        """Run jobs; see `Engine.run`."""
        # Before anything runs: whoever asks for too many GPUs is told at once.
        needs = max((job.needs for job in jobs), key=lambda item: item.gpus, default=Needs())
        places: queue.SimpleQueue[tuple[int, dict[str, str]]] = queue.SimpleQueue()
        for place in enumerate(divide_gpus(self._at_once, needs, visible_gpus()), start=1):
            places.put(place)
        stop = threading.Event()
        failures: list[HwpError] = []

        def run_one(index: int) -> None:
            place, gpus = places.get()
            try:
                if not stop.is_set() and not jobs[index].finished():
                    self._run(index, jobs[index], place, gpus, stop)
            finally:
                places.put((place, gpus))

        with self._view as view, ThreadPoolExecutor(self._at_once) as pool:
            view.begin(len(jobs))
            waiting = {pool.submit(run_one, index): index for index in range(len(jobs))}
            try:
                while waiting:
                    # A wait without end would not let Ctrl-C through on every system.
                    for future in wait(waiting, 1.0, FIRST_COMPLETED).done:
                        index, error = waiting.pop(future), future.exception()
                        if error is not None and not isinstance(error, HwpError):
                            raise error
                        view.end(index, jobs[index].text, None if error is None else str(error))
                        if error is None:
                            on_done(index)
                        else:
                            failures.append(error)
            finally:
                stop.set()
        raise_first(failures, len(jobs))

    def _run(
        self, index: int, job: Job, place: int, gpus: dict[str, str], stop: threading.Event
    ) -> None:
        local = LocalJob(
            job.work,
            {name: folder.path.absolute() for name, folder in job.inputs.items()},
            job.output.absolute(),
            {**thread_environment(job.needs), **gpus},
        )
        for attempt in range(RETRIES + 1):
            self._view.start(index, job.text, f"place {place}")
            try:
                run_in_process(
                    local, lambda done, total: self._view.steps(index, done, total), stop.is_set
                )
                return
            except WorkerLost as error:
                if attempt == RETRIES:
                    raise lost_error(job.text, str(error)) from error


def lost_error(text: str, reason: str) -> HwpError:
    """Return the error of a job that lost its worker too often."""
    return HwpError(
        f"the worker of the job {text!r} was lost {RETRIES + 1} times ({reason})",
        remedy="Is there enough memory? Start again with the same arguments: finished jobs stay.",
    )


def visible_gpus() -> list[str]:
    """Return the GPUs that this process may use, as `CUDA_VISIBLE_DEVICES` names them."""
    if VISIBLE_GPUS in os.environ:
        return [name.strip() for name in os.environ[VISIBLE_GPUS].split(",") if name.strip()]
    # The driver's own list; asking it costs no import of a GPU library.
    cards = Path("/proc/driver/nvidia/gpus")
    return [str(number) for number, _ in enumerate(cards.iterdir())] if cards.is_dir() else []


def divide_gpus(jobs: int, needs: Needs, gpus: list[str]) -> list[dict[str, str]]:
    """Divide GPUs among jobs that run at once."""
    if needs.gpus == 0:
        return [{} for _ in range(jobs)]
    each = 1 if needs.gpus <= 1 else math.ceil(needs.gpus)
    sharing = max(1, int(1 / needs.gpus + 1e-9))
    needed = math.ceil(jobs / sharing) * each
    if needed > len(gpus):
        raise UsageError(
            f"{jobs} jobs of {needs.gpus:g} GPUs at once need {needed} GPUs, and there are "
            f"{len(gpus)}",
            field="--jobs",
            remedy="Run fewer at once, or give each a fraction of a GPU with --job-gpus.",
        )
    first = [slot // sharing * each for slot in range(jobs)]
    return [{VISIBLE_GPUS: ",".join(gpus[start : start + each])} for start in first]


# --- one job in one process


class WorkerLost(Exception):
    """The process of a job was killed by something outside the job."""


class Stopped(Exception):
    """The job was stopped because its result is no longer needed."""


@dataclass(frozen=True)
class LocalJob:
    """A job on the machine where it runs."""

    #: The work, where its inputs lie, and the folder of its result.
    work: Work
    inputs: Mapping[str, Path]
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
    """Run a job in a process and wait for it."""
    with tempfile.TemporaryDirectory(prefix="hwp-job-") as name:
        messages = Path(name)
        with open(messages / _LOG, "wb") as log:
            process = _start(job, messages, log.fileno())
        try:
            while process.poll() is None:
                if stop():
                    raise Stopped
                if (messages / _PROGRESS).is_file():
                    with contextlib.suppress(BadInput):
                        on_progress(*read_json(messages / _PROGRESS))
                with contextlib.suppress(subprocess.TimeoutExpired):
                    process.wait(_POLL_SECONDS)
        finally:
            _end(process)
        _raise_failure(process.returncode, messages)


def _start(job: LocalJob, messages: Path, log: int) -> subprocess.Popen[bytes]:
    path = [os.fspath(PACKAGES), *filter(None, [os.environ.get("PYTHONPATH")])]
    process = subprocess.Popen(
        [sys.executable, *START, "hwp_bench.run.engine.processes"],
        stdin=subprocess.PIPE,
        stdout=log,
        stderr=log,
        env={**os.environ, **job.environment, "PYTHONPATH": os.pathsep.join(path)},
        # Ctrl-C must reach it once, from us.
        start_new_session=True,
    )
    assert process.stdin is not None
    with contextlib.suppress(BrokenPipeError), process.stdin as stream:
        stream.write(pickle.dumps((job, messages, os.getpid())))
    return process


def _end(process: subprocess.Popen[bytes]) -> None:
    """Stop a process that still runs, kindly first, so that it stops what it started."""
    if process.poll() is None:
        process.terminate()
        with contextlib.suppress(subprocess.TimeoutExpired):
            process.wait(GRACE_SECONDS)
    with contextlib.suppress(ProcessLookupError, PermissionError):
        os.killpg(process.pid, signal.SIGKILL)
    process.wait()


def _raise_failure(status: int, messages: Path) -> None:
    if status == 0:
        return
    if (messages / _FAILURE).is_file():
        raise parse_error(read_json(messages / _FAILURE))
    if status < 0:
        raise WorkerLost(signal.Signals(-status).name)
    if status == _INTERRUPTED:
        # By somebody else: a stop that was asked for here raises `Stopped` before this line.
        raise WorkerLost("interrupted")
    lines = (messages / _LOG).read_text(errors="replace").strip().splitlines()
    raise HwpError(f"a job broke: {lines[-1][:500] if lines else f'exit status {status}'}")


# --- inside the process


def main() -> int:
    """Read one job from standard input and do it; returns the exit status."""
    signal.signal(signal.SIGTERM, signal.default_int_handler)
    # The job comes from our own parent process through a pipe.
    job, messages, parent = pickle.load(sys.stdin.buffer)
    folders = [messages, *job.scratch]
    threading.Thread(target=_watch, args=(parent, folders), daemon=True).start()
    due = 0.0

    def note(done: int, total: int) -> None:
        """Write down how far the job is, not too often; an orphan is stopped at its next step."""
        nonlocal due
        if os.getppid() != parent:
            raise KeyboardInterrupt
        if (now := time.monotonic()) >= due:
            due = now + LOOK_SECONDS
            with contextlib.suppress(HwpError):
                write_json(messages / _PROGRESS, [int(done), int(total)])

    try:
        job.work(job.inputs, job.output, note)
    except HwpError as error:
        write_json(messages / _FAILURE, error_record(error))
        return 1
    except KeyboardInterrupt:
        return _INTERRUPTED
    finally:
        if os.getppid() != parent:
            _remove(folders)
    return 0


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


# --- errors on the way between processes and nodes


def error_record(error: HwpError) -> dict[str, str | None]:
    """Return an error as JSON, on its way to another process or node; `parse_error` reads it."""
    parts = {name: getattr(error, name) for name in ("problem", "where", "field", "remedy")}
    return {"kind": type(error).__name__, **parts}


def parse_error(value: Mapping[str, str | None]) -> HwpError:
    """Return the error of an `error_record`."""
    kind: type[HwpError] = getattr(errors, str(value["kind"]), HwpError)
    parts = {name: value[name] for name in ("where", "field", "remedy")}
    return kind(str(value["problem"]), **parts)
