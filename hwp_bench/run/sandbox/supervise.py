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
from typing import IO, Any

from hwp_bench.base.errors import MethodFailed, shown
from hwp_bench.base.folders import open_up
from hwp_bench.base.packages import PACKAGES
from hwp_bench.run.sandbox import memory
from hwp_bench.run.sandbox.memory import ControlGroup, Measure
from hwp_bench.run.sandbox.root import Place

#: Bytes of a program's output that are kept, half of its beginning and half of its end; the middle
#: is counted and thrown away.
MAX_LOG_BYTES = 1024 * 1024
#: Most processes that a program may have at once.
MAX_PROCESSES = 1024

_POLL_SECONDS = 0.05
# Memory is measured this often, and at every poll where more than half of the limit is taken.
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
    #: Whether files that exist in memory alone can be made inside the walls; drivers of
    #: accelerators may need them.
    memory_files: bool = False


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
    #: Which limit stopped it (`time`, `memory`, `processes`), `machine` where the machine's memory
    #: ran out, or None.
    stopped: str | None = None
    #: Whether the kernel ended processes meanwhile, of this program or another, for want of memory.
    starved: bool = False
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
    watch = _Watch(process, limits, _join_group(process, limits))
    assert process.stdin is not None
    assert process.stdout is not None
    drain = threading.Thread(target=_drain, args=(process.stdout, log, log_problems), daemon=True)
    drain.start()
    with os.fdopen(read, "rb") as report:
        try:
            with contextlib.suppress(BrokenPipeError):
                process.stdin.write(_order(program))
                process.stdin.close()
            stopped = watch.wait(on_poll)
        finally:
            _end(process)
            drain.join(timeout=5)
            if not drain.is_alive():  # what it reads from must not be taken from it
                process.stdout.close()
            starved = watch.finish()
        text = report.read()
    lost = log_problems[0] if log_problems else None
    if stopped is not None:
        return ProcessOutcome(None, stopped, log_problem=lost)
    if watch.over:
        return ProcessOutcome(None, "memory", log_problem=lost)
    answer: dict[str, Any] = json.loads(text) if text else {"status": process.returncode}
    if answer.get("stage") == "sandbox":
        return ProcessOutcome(None, refused=answer["problem"])
    if answer.get("stage") == "command":
        raise MethodFailed(
            f"cannot be started ({answer['problem']})",
            where=program.command[0],
            field="entry.command",
            remedy=_unseen(program.command[0]) if program.places is not None else None,
        )
    return ProcessOutcome(answer["status"], starved=starved, log_problem=lost)


def _unseen(word: str) -> str:
    """What may be wrong with a program that cannot be started inside the walls."""
    leads = ""
    with contextlib.suppress(OSError):  # links of the process table are closed to most
        real = os.path.realpath(word)
        leads = f" It leads to {shown(real)}." if os.path.isabs(word) and real != word else ""
    return (
        "A method sees the programs of the system, the toolkit's Python and its own folder, but "
        f"not what links in that folder lead to.{leads} If you trust it and it needs another "
        "interpreter, show it with --expose, its environment and what that was made from."
    )


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
        "memory_files": program.memory_files,
    }
    return json.dumps(order).encode()


def _join_group(process: subprocess.Popen[bytes], limits: Limits) -> ControlGroup | None:
    """Put a launcher into a control group, where there can be one; it still waits for its order."""
    group = memory.control_group(limits.memory)
    if group is None:
        return None
    try:
        group.take(process.pid)
    except OSError:
        group.remove()
        return None
    return group


class _Watch:
    """Waits for the end of a program, and looks how long it runs and what it takes.

    Args:
        process: the launcher.
        limits: when the program is to be stopped.
        group: the control group of its processes, if there is one.
    """

    def __init__(
        self, process: subprocess.Popen[bytes], limits: Limits, group: ControlGroup | None
    ) -> None:
        self._process = process
        self._limits = limits
        self._group = group
        self._measure = Measure()
        self._kills = memory.kernel_kills()
        #: Whether the kernel ended processes because they took more than the limit.
        self.over = False

    def wait(self, on_poll: Callable[[], None] | None) -> str | None:
        """Wait for the end; returns the limit that the program broke, if any."""
        deadline = time.monotonic() + self._limits.seconds
        due = 0.0
        while self._process.poll() is None:
            now = time.monotonic()
            if now > deadline:
                return "time"
            if now >= due:
                family = _processes_of(self._process.pid)
                memory.offer_to_kernel(family)
                used = self._measure.used(family, self._limits.memory)
                broken = self._broken(family, used)
                if broken is not None:
                    return broken
                due = now + (0.0 if used > self._limits.memory / 2 else _MEASURE_SECONDS)
                if on_poll is not None:
                    on_poll()
            time.sleep(_POLL_SECONDS)
        return None

    def _broken(self, family: Sequence[int], used: int) -> str | None:
        if len(family) > MAX_PROCESSES:
            return "processes"
        if used > self._limits.memory or (self._group is not None and self._group.kills()):
            return "memory"
        return "machine" if memory.machine_is_short() else None

    def finish(self) -> bool:
        """Remove the control group when all has ended; returns whether the kernel lacked memory."""
        if self._group is not None:
            self.over = self._group.kills() > 0
            self._group.remove()
        return memory.kernel_kills() > self._kills


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


def _processes_of(root: int) -> list[int]:
    """Return the running descendants of a process, as far as the system shows them."""
    import psutil

    with contextlib.suppress(psutil.Error):
        return [child.pid for child in psutil.Process(root).children(recursive=True)]
    return []
