"""Run a job in a process of its own, which ends with all that it started.

`run_in_process` starts the process, watches it, and raises the job's error. `main` is what runs
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
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path

from hwp_bench.base import errors
from hwp_bench.base.console import JobsView
from hwp_bench.base.errors import BadInput, HwpError, UsageError
from hwp_bench.base.files import read_json, write_json
from hwp_bench.base.packages import PACKAGES
from hwp_bench.run import START
from hwp_bench.run.engine.job import (
    RETRIES,
    Failures,
    Job,
    Needs,
    OnDone,
    OnProgress,
    OnStart,
    Work,
    worker_lost_error,
)

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
_START = (*START, "hwp_bench.run.engine.processes")


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
    """Run a job in a process and wait for it."""
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


class ParallelEngine:
    """Runs up to `at_once` jobs at once; a job whose process is killed is started again."""

    in_turn = False

    def __init__(
        self, at_once: int, view: JobsView | None = None, *, retries: int = RETRIES
    ) -> None:
        self._at_once = at_once
        self._view = view or JobsView(quiet=True)
        self._retries = retries

    def __enter__(self) -> ParallelEngine:
        return self

    def __exit__(self, *_: object) -> None:
        pass

    def run(self, jobs: Sequence[Job], on_done: OnDone, on_start: OnStart | None = None) -> None:
        """Run jobs; see `Engine.run`."""
        # Before anything runs: whoever asks for too many GPUs is told at once.
        visible = visible_gpus()
        needs = max((job.needs for job in jobs), key=lambda item: item.gpus, default=Needs())
        places: queue.SimpleQueue[tuple[int, dict[str, str]]] = queue.SimpleQueue()
        for place in enumerate(divide_gpus(self._at_once, needs, visible), start=1):
            places.put(place)
        ended: queue.SimpleQueue[tuple[int, BaseException | None]] = queue.SimpleQueue()
        stop = threading.Event()
        failures = Failures()

        def run_one(index: int) -> None:
            place, environment = places.get()
            try:
                if not stop.is_set():
                    self._run(index, jobs[index], place, environment, stop)
                ended.put((index, None))
            except BaseException as error:
                ended.put((index, error))
            finally:
                places.put((place, environment))

        with self._view as view, ThreadPoolExecutor(self._at_once) as pool:
            try:
                view.begin(len(jobs))
                for index in range(len(jobs)):
                    pool.submit(run_one, index)
                for _ in jobs:
                    index, error = _next(ended)
                    if error is not None and not isinstance(error, HwpError):
                        raise error
                    view.end(index, jobs[index].text, None if error is None else str(error))
                    if error is None:
                        on_done(index)
                    else:
                        failures.add(error)
            finally:
                stop.set()
        failures.raise_first(len(jobs))

    def _run(
        self, index: int, job: Job, place: int, gpus: dict[str, str], stop: threading.Event
    ) -> None:
        if job.finished():
            return
        local = LocalJob(
            job.work,
            {name: folder.path.absolute() for name, folder in job.inputs.items()},
            job.output.absolute(),
            {**thread_environment(job.needs), **gpus},
        )
        for attempt in range(self._retries + 1):
            self._view.start(index, job.text, f"place {place}")
            try:
                run_in_process(
                    local, lambda done, total: self._view.steps(index, done, total), stop.is_set
                )
                return
            except WorkerLost as error:
                if attempt == self._retries:
                    raise worker_lost_error(job.text, self._retries, str(error)) from error


def _next(
    ended: queue.SimpleQueue[tuple[int, BaseException | None]],
) -> tuple[int, BaseException | None]:
    # A wait without end would not let Ctrl-C through on every system.
    while True:
        try:
            return ended.get(timeout=1.0)
        except queue.Empty:
            continue


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
