"""Start an untrusted program in its sandbox, watch its time and memory, and end all of it."""

from __future__ import annotations

import contextlib
import io
import json
import os
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import IO, TYPE_CHECKING, Any

from hwp_bench.base.errors import MethodFailed
from hwp_bench.base.packages import PACKAGES
from hwp_bench.base.trees import open_up
from hwp_bench.run.sandbox.root import Place

if TYPE_CHECKING:
    import psutil

#: Bytes of a program's output that are kept, half of its beginning and half of its end; the middle
#: is counted and thrown away.
MAX_LOG_BYTES = 1024 * 1024
#: Most processes that a program may have at once.
MAX_PROCESSES = 1024

_POLL_SECONDS = 0.05
_MEASURE_SECONDS = 0.2
# A bare interpreter, so that a run starts within a few hundredths of a second.
_LAUNCH = (
    "import sys; sys.path.insert(0, {root!r}); from hwp_bench.run.sandbox.launch import main; "
)


@dataclass(frozen=True)
class Program:
    """An untrusted program: what is run, and where."""

    #: The words of its command.
    command: Sequence[str]
    #: Its working folder.
    folder: Path
    #: All its environment variables.
    environment: Mapping[str, str]
    #: The places of the file system that it sees; None starts it without namespaces.
    places: Sequence[Place] | None
    #: File that takes what it prints.
    log: Path


@dataclass(frozen=True)
class Limits:
    """When a program is stopped."""

    #: Wall time, seconds.
    seconds: float
    #: Memory of all its processes together, bytes.
    memory: int


@dataclass(frozen=True)
class ProcessOutcome:
    """How a program ended."""

    #: Exit status, below 0 a signal's number; None where it was stopped or never started.
    status: int | None
    #: Which limit stopped it (`time`, `memory`, `processes`), or None.
    stopped: str | None = None
    #: Why there was no sandbox, or None.
    refused: str | None = None
    #: Why not all of the log could be written, or None.
    log_problem: str | None = None


def run_confined(
    program: Program, limits: Limits, on_poll: Callable[[], None] | None = None
) -> ProcessOutcome:
    """Run a program to its end; whatever ends it, no process of it is left.

    Args:
        program: what to run.
        limits: when to stop it.
        on_poll: called some times a second meanwhile.

    Raises:
        MethodFailed: there is no such command, or it cannot be executed.
    """
    log_problems: list[str] = []
    # Before the program runs: it may write next to its log, and put a link in the place of one
    # that is not there yet.
    log = _open_log(program.log, log_problems)
    read, write = os.pipe()
    root = os.fspath(PACKAGES)
    bare = [sys.executable, "-I", "-S", "-B", "-c", _LAUNCH.format(root=root) + f"main({write})"]
    process = subprocess.Popen(
        bare,
        env=dict(program.environment),
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        start_new_session=True,
        pass_fds=(write,),
    )
    os.close(write)
    assert process.stdin is not None
    assert process.stdout is not None
    drain = threading.Thread(target=_drain, args=(process.stdout, log, log_problems), daemon=True)
    drain.start()
    with os.fdopen(read, "rb") as report:
        try:
            with contextlib.suppress(BrokenPipeError):
                process.stdin.write(_order(program))
                process.stdin.close()
            stopped = _watch(process, limits, on_poll)
        finally:
            _end(process)
            drain.join(timeout=5)
            if not drain.is_alive():  # what it reads from must not be taken from it
                process.stdout.close()
        text = report.read()
    lost = log_problems[0] if log_problems else None
    if stopped is not None:
        return ProcessOutcome(None, stopped, log_problem=lost)
    answer: dict[str, Any] = json.loads(text) if text else {"status": process.returncode}
    if answer.get("stage") == "sandbox":
        return ProcessOutcome(None, refused=answer["problem"])
    if answer.get("stage") == "command":
        raise MethodFailed(
            f"cannot be started ({answer['problem']})",
            where=program.command[0],
            field="entry.command",
        )
    return ProcessOutcome(answer["status"], log_problem=lost)


def remove_odd_files(folder: Path) -> None:
    """Remove links, pipes, sockets and devices from a folder and all folders in it, and open it.

    A link that leads nowhere inside a sandbox leads to real files outside it: the toolkit would
    read a test frame for a prediction. To be called when no process of the program is left.
    """
    open_up(folder)


def _order(program: Program) -> bytes:
    order = {
        "command": list(program.command),
        "folder": os.fspath(program.folder),
        "environment": dict(program.environment),
        "places": program.places,
        "parent": os.getpid(),
    }
    return json.dumps(order).encode()


def _watch(
    process: subprocess.Popen[bytes], limits: Limits, on_poll: Callable[[], None] | None
) -> str | None:
    """Wait for the end of a process; returns the limit that it broke, if any."""
    deadline = time.monotonic() + limits.seconds
    measure = 0.0
    while process.poll() is None:
        now = time.monotonic()
        if now > deadline:
            return "time"
        if now >= measure:
            measure = now + _MEASURE_SECONDS
            family = _processes_of(process.pid)
            if len(family) > MAX_PROCESSES:
                return "processes"
            if _memory_of(family, limits.memory) > limits.memory:
                return "memory"
            if on_poll is not None:
                on_poll()
        time.sleep(_POLL_SECONDS)
    return None


def _end(process: subprocess.Popen[bytes]) -> None:
    """End a launcher and everything below it."""
    if process.poll() is None:
        # It takes its descendants along, or the kernel does, with their process namespace.
        process.terminate()
        with contextlib.suppress(subprocess.TimeoutExpired):
            process.wait(timeout=10)
    # The rest, where there are no namespaces and the launcher itself was killed.
    with contextlib.suppress(ProcessLookupError, PermissionError):
        os.killpg(process.pid, signal.SIGKILL)
    process.wait()


def _open_log(path: Path, problems: list[str]) -> io.FileIO | None:
    """Open the file of a log, never through a link; None and a reason where that fails."""
    flags = os.O_WRONLY | os.O_CREAT | os.O_TRUNC | os.O_NOFOLLOW | os.O_CLOEXEC
    try:
        return io.FileIO(os.open(path, flags, 0o666), "wb")
    except OSError as error:
        problems.append(_why(error))
        return None


def _drain(stream: IO[bytes], log: io.FileIO | None, problems: list[str]) -> None:
    """Keep both ends of what a program prints: what it is, and what it died of.

    Where the log cannot be written, on a full disc for instance, the rest is read all the same:
    a program whose output nobody reads stands still as soon as the pipe is full.

    Args:
        stream: what the program prints.
        log: the file, which is closed at the end; None where it could not be opened.
        problems: takes the reason why the log is not whole.
    """
    if log is not None:
        try:
            with log:
                _keep_ends(stream, log)
        except OSError as error:
            problems.append(_why(error))
    while os.read(stream.fileno(), 65536):
        pass


def _why(error: OSError) -> str:
    return error.strerror or type(error).__name__


def _keep_ends(stream: IO[bytes], target: io.FileIO) -> None:
    half = MAX_LOG_BYTES // 2
    kept = 0
    dropped = 0
    tail = bytearray()
    # The file is unbuffered: what comes can be followed, and no rest waits for a disc that is
    # full. Whatever has come is taken, and not whole blocks, for the same reason.
    while chunk := os.read(stream.fileno(), 65536):
        head = chunk[: half - kept]
        _write_all(target, head)
        kept += len(head)
        tail += chunk[len(head) :]
        surplus = max(0, len(tail) - half)
        del tail[:surplus]
        dropped += surplus
    if dropped:
        _write_all(target, f"\n[{dropped} bytes in the middle were not kept]\n".encode())
    _write_all(target, tail)


def _write_all(target: io.FileIO, data: bytes | bytearray) -> None:
    """Write data to an unbuffered file, which may take it in parts."""
    rest = memoryview(bytes(data))
    while rest:
        rest = rest[target.write(rest) :]


def _processes_of(root: int) -> list[psutil.Process]:
    """Return the running descendants of a process, as far as the system shows them."""
    import psutil

    with contextlib.suppress(psutil.Error):
        return psutil.Process(root).children(recursive=True)
    return []


def _memory_of(processes: Sequence[psutil.Process], enough: int) -> int:
    """Return the memory of some processes together, bytes.

    Shared memory is counted once. That is slow to find out, so it is done only where the plain
    sum, which is never smaller, is above `enough`.
    """
    total = sum(_resident(process) for process in processes)
    return total if total <= enough else sum(_proportional(process) for process in processes)


def _resident(process: psutil.Process) -> int:
    import psutil

    with contextlib.suppress(psutil.Error):
        return process.memory_info().rss
    return 0


def _proportional(process: psutil.Process) -> int:
    import psutil

    with contextlib.suppress(psutil.Error, AttributeError):
        return process.memory_full_info().pss
    return _resident(process)
