"""Run a method on one capture in a process of its own, away from the test frames."""

from __future__ import annotations

import contextlib
import os
import shutil
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import IO

from hwp_bench.errors import BadInput, BadMethod, MethodFailed
from hwp_bench.files import read_json
from hwp_bench.methods.facts import RunFacts, read_facts
from hwp_bench.methods.manifest import MethodManifest
from hwp_bench.methods.worker import FAILURE, PREDICTIONS, PROGRESS, RUN

#: Bytes of a method's output that are kept; the rest is counted and thrown away.
MAX_LOG_BYTES = 1024 * 1024
#: Seconds a method may take on one capture unless told otherwise.
DEFAULT_TIME_LIMIT = 3600.0
#: Environment variables that a method's process inherits.
ENVIRONMENT = (
    "CUDA_VISIBLE_DEVICES",
    "HOME",
    "HWP_CACHE",
    "LANG",
    "LC_ALL",
    "LD_LIBRARY_PATH",
    "MKL_NUM_THREADS",
    "NUMBA_CACHE_DIR",
    "NUMBA_NUM_THREADS",
    "OMP_NUM_THREADS",
    "PATH",
    "PYTHONPATH",
    "TMPDIR",
    "TORCH_HOME",
    "VIRTUAL_ENV",
    "XDG_CACHE_HOME",
)

_POLL_SECONDS = 0.05


@dataclass(frozen=True)
class RunRecord:
    """What a run left behind."""

    #: Folder of the predicted frames.
    predictions: Path
    #: What `run.json` says; says nothing for submitted predictions.
    facts: RunFacts
    #: Wall time of the whole process, start-up included, seconds.
    wall_seconds: float


def run_method(
    manifest: MethodManifest,
    capture_id: str,
    request: Path,
    output: Path,
    *,
    time_limit: float = DEFAULT_TIME_LIMIT,
    on_progress: Callable[[int, int], None] | None = None,
) -> RunRecord:
    """Run a method on a request.

    Args:
        manifest: the method.
        capture_id: names the folder of a submission's predictions.
        request: the request folder.
        output: a folder of the run's own; emptied first.
        time_limit: seconds after which the process and its children are killed.
        on_progress: called with (done, total) steps now and then.

    Returns:
        Where the predictions lie, and what the run took.

    Raises:
        MethodFailed: it crashed, or ran out of time; the message names the log.
        BadMethod: a submission has no predictions for this capture.
    """
    if manifest.kind == "predictions":
        folder = manifest.root / str(manifest.entry) / capture_id
        if not folder.is_dir():
            raise BadMethod(
                f"has no predictions for {capture_id}",
                where=folder,
                remedy=f"Put the frames into {manifest.entry}/{capture_id}/.",
            )
        return RunRecord(folder, RunFacts(), 0.0)
    shutil.rmtree(output, ignore_errors=True)
    output.mkdir(parents=True)
    log = output / "log.txt"
    started = time.perf_counter()
    status = _supervise(_command(manifest, request, output), output, log, time_limit, on_progress)
    wall = time.perf_counter() - started
    if status is None:
        raise MethodFailed(
            f"{manifest.name} ran out of time on {capture_id} after {time_limit:g} s",
            where=log,
            remedy="Raise --time-limit, or give the method a --budget.",
        )
    if status != 0:
        raise MethodFailed(
            f"{manifest.name} failed on {capture_id}: {_reason(output, status)}",
            where=log,
            remedy="The log holds what it printed.",
        )
    if manifest.kind == "python" and not (output / RUN).is_file():
        raise MethodFailed(
            f"{manifest.name} ended before it had rendered every frame of {capture_id}", where=log
        )
    try:
        facts = read_facts(output / RUN)
    except BadInput as error:
        problem = f"{manifest.name} wrote a {RUN} that cannot be read ({error.problem})"
        raise MethodFailed(problem, where=log, field=error.field) from error
    return RunRecord(output / PREDICTIONS, facts, wall)


def _command(manifest: MethodManifest, request: Path, output: Path) -> list[str]:
    if manifest.kind == "python":
        worker = [sys.executable, "-m", "hwp_bench.methods.worker"]
        method = ["--method", str(manifest.root.resolve()), "--entry", str(manifest.entry)]
        return [*worker, str(request.resolve()), str(output.resolve()), *method]
    places = {
        "{request}": str(request.resolve()),
        "{output}": str(output.resolve()),
        "{method}": str(manifest.root.resolve()),
        "{python}": sys.executable,
    }
    words = []
    for word in manifest.entry:
        for place, value in places.items():
            word = word.replace(place, value)
        words.append(word)
    return words


def _supervise(
    command: Sequence[str],
    folder: Path,
    log: Path,
    time_limit: float,
    on_progress: Callable[[int, int], None] | None,
) -> int | None:
    """Run a command; returns its exit status, or None when it had to be killed for time."""
    environment = {name: os.environ[name] for name in ENVIRONMENT if name in os.environ}
    try:
        process = subprocess.Popen(
            command,
            cwd=folder,
            env=environment,
            stdin=subprocess.DEVNULL,
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            start_new_session=True,
            close_fds=True,
        )
    except OSError as error:
        raise MethodFailed(
            f"cannot be started ({error.strerror})", where=command[0], field="entry.command"
        ) from error
    assert process.stdout is not None
    drain = threading.Thread(target=_drain, args=(process.stdout, log), daemon=True)
    drain.start()
    deadline = time.monotonic() + time_limit
    next_look = 0.0
    try:
        while process.poll() is None:
            now = time.monotonic()
            if now > deadline:
                return None
            if on_progress is not None and now >= next_look:
                next_look = now + 0.5
                _show_progress(folder / PROGRESS, on_progress)
            time.sleep(_POLL_SECONDS)
        return process.returncode
    finally:
        # Children that outlive the method's process die with it, whatever ended it.
        with contextlib.suppress(ProcessLookupError, PermissionError):
            os.killpg(process.pid, signal.SIGKILL)
        process.wait()
        drain.join(timeout=5)


def _drain(stream: IO[bytes], log: Path) -> None:
    kept = 0
    dropped = 0
    with open(log, "wb") as target:
        while chunk := stream.read(65536):
            part = chunk[: MAX_LOG_BYTES - kept]
            target.write(part)
            kept += len(part)
            dropped += len(chunk) - len(part)
        if dropped:
            target.write(f"\n[{dropped} further bytes were not kept]\n".encode())


def _show_progress(path: Path, on_progress: Callable[[int, int], None]) -> None:
    with contextlib.suppress(BadInput, KeyError, TypeError, ValueError):
        value = read_json(path, max_bytes=10_000)
        on_progress(int(value["done"]), int(value["total"]))


def _reason(output: Path, status: int) -> str:
    with contextlib.suppress(BadInput, KeyError, TypeError):
        return str(read_json(output / FAILURE, max_bytes=100_000)["problem"])
    if status < 0:
        with contextlib.suppress(ValueError):
            return f"killed by {signal.Signals(-status).name}"
    return f"exit status {status}"
