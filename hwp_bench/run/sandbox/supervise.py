"""Start an untrusted program in its sandbox, watch its time and memory, and end all of it.

Where this user may make a memory control group, the kernel counts and enforces. Elsewhere memory is
measured from outside, several times a second: that of processes, and that of files in scratch
folders, memory files and shared mappings, which may outlive them.
"""

from __future__ import annotations

import contextlib
import io
import json
import os
import secrets
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import IO, Any

from hwp_bench.base.errors import MethodFailed, reason_of, shown
from hwp_bench.base.packages import PACKAGES
from hwp_bench.run.sandbox.launch import Place

#: Share of the free memory that a program may take unless told otherwise.
DEFAULT_SHARE = 0.9
#: Least free memory of a machine, as a share of all and at most in bytes, before a program ends.
FLOOR_SHARE, FLOOR_BYTES = 0.015, 256 << 20
#: Largest size of a scratch folder, bytes, and the most of the limit that it may be.
SCRATCH_BYTES, SCRATCH_SHARE = 1 << 30, 0.25
#: Folders in memory that a program in a sandbox may write to.
SCRATCH = ("/tmp", "/var/tmp", "/dev/shm")
_CONTROL = Path("/sys/fs/cgroup")
_FIRST_TO_END = "1000"
_PREFIX, _NEW_SECONDS = "hwp-bench-", 600.0
_MEMORY_FILE, _SHARED_MAPPING = "/memfd:", b"/dev/zero (deleted)"
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

    #: Its command, its working folder, and all its environment variables.
    command: Sequence[str]
    folder: Path
    environment: Mapping[str, str]
    #: The places of the file system that it sees; None starts it without namespaces.
    places: Sequence[Place] | None
    #: File that takes what it prints.
    log: Path
    #: Whether files that exist in memory alone can be made inside the sandbox; drivers of
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
    """Run a program to its end; whatever ends it, no process of it is left."""
    log_problems: list[str] = []
    # Before the program runs: it may write next to its log, and put a link in the place of one
    # that is not there yet.
    log = _open_log(program.log, log_problems)
    read, write = os.pipe()
    start = _LAUNCH.format(root=os.fspath(PACKAGES)) + f"main({write})"
    process = subprocess.Popen(
        [sys.executable, "-I", "-S", "-B", "-c", start],
        env=dict(program.environment),
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        start_new_session=True,
        pass_fds=(write,),
    )
    os.close(write)
    # It still waits for its order.
    watch = _Watch(process, limits, control_group(limits.memory, process.pid))
    assert process.stdin is not None
    assert process.stdout is not None
    drain = threading.Thread(target=_drain, args=(process.stdout, log, log_problems), daemon=True)
    drain.start()
    order = {
        "command": list(program.command),
        "folder": os.fspath(program.folder),
        "environment": dict(program.environment),
        "places": program.places,
        "parent": os.getpid(),
        "memory_files": program.memory_files,
    }
    with os.fdopen(read, "rb") as report:
        try:
            with contextlib.suppress(BrokenPipeError):
                process.stdin.write(json.dumps(order).encode())
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
    if stopped is not None or watch.over:
        return ProcessOutcome(None, stopped or "memory", log_problem=lost)
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
    """What may be wrong with a program that cannot be started inside the sandbox."""
    leads = ""
    with contextlib.suppress(OSError):  # links of the process table are closed to most
        real = os.path.realpath(word)
        leads = f" It leads to {shown(real)}." if os.path.isabs(word) and real != word else ""
    return (
        "A method sees the programs of the system, the toolkit's Python and its own folder, but "
        f"not what links in that folder lead to.{leads} If you trust it and it needs another "
        "interpreter, show it with --expose, its environment and what that was made from."
    )


class _Watch:
    """Waits for the end of a program, and looks how long it runs and what it takes."""

    def __init__(
        self, process: subprocess.Popen[bytes], limits: Limits, group: ControlGroup | None
    ) -> None:
        self._process = process
        self._limits = limits
        self._group = group
        self._measure = Measure()
        self._kills = kernel_kills()
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
                offer_to_kernel(family)
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
        return "machine" if machine_is_short() else None

    def finish(self) -> bool:
        """Remove the control group when all has ended; returns whether the kernel lacked memory."""
        if self._group is not None:
            self.over = self._group.kills() > 0
            self._group.remove()
        return kernel_kills() > self._kills


def _processes_of(root: int) -> list[int]:
    """Return the running descendants of a process, that the system shows."""
    import psutil

    with contextlib.suppress(psutil.Error):
        return [child.pid for child in psutil.Process(root).children(recursive=True)]
    return []


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


# --- the log


def _open_log(path: Path, problems: list[str]) -> io.FileIO | None:
    """Open the file of a log, never through a link; None and a reason where that fails."""
    flags = os.O_WRONLY | os.O_CREAT | os.O_TRUNC | os.O_NOFOLLOW | os.O_CLOEXEC
    try:
        return io.FileIO(os.open(path, flags, 0o666), "wb")
    except OSError as error:
        problems.append(reason_of(error))
        return None


def _drain(stream: IO[bytes], log: io.FileIO | None, problems: list[str]) -> None:
    """Keep both ends of what a program prints: what it is, and what it died of.

    Where the log cannot be written, on a full disc for instance, the rest is read all the same:
    a program whose output nobody reads stands still as soon as the pipe is full.
    """
    if log is not None:
        try:
            with log:
                _keep_ends(stream, log)
        except OSError as error:
            problems.append(reason_of(error))
    while os.read(stream.fileno(), 65536):
        pass


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


# --- memory


def default_limit() -> int:
    """Return nine tenths of the memory that is free now, bytes; of a container, of its share."""
    import psutil

    free = psutil.virtual_memory().available
    with contextlib.suppress(OSError, ValueError):
        most, used = (
            int((_CONTROL / name).read_text()) for name in ("memory.max", "memory.current")
        )
        free = min(free, max(0, most - used))
    return int(DEFAULT_SHARE * free)


def scratch_bytes(limit: int) -> int:
    """Return the size of each scratch folder under a limit, bytes."""
    return int(min(SCRATCH_BYTES, SCRATCH_SHARE * limit))


def machine_is_short() -> bool:
    """Whether the machine has so little memory left that it may stand still."""
    import psutil

    memory = psutil.virtual_memory()
    return bool(memory.available < min(FLOOR_BYTES, FLOOR_SHARE * memory.total))


def kernel_kills() -> int:
    """Return how many processes the kernel has ended for want of memory since the start."""
    return _kills("/proc/vmstat")


def _kills(table: str | Path) -> int:
    """The kills for want of memory in a table of the kernel; 0 where it has no count."""
    with contextlib.suppress(OSError, ValueError), open(table) as lines:
        for line in lines:
            name, _, count = line.partition(" ")
            if name == "oom_kill":
                return int(count)
    return 0


def offer_to_kernel(processes: Iterable[int]) -> None:
    """Have the kernel end these processes first, and not others, when memory runs out.

    They may take it back, so that it is set again at every look.
    """
    for process in processes:
        with contextlib.suppress(OSError), open(f"/proc/{process}/oom_score_adj", "r+") as stream:
            if stream.read().strip() != _FIRST_TO_END:
                stream.seek(0)
                stream.write(_FIRST_TO_END)


@dataclass
class Measure:
    """Measures the memory of a program from outside."""

    # Largest size of each shared mapping that is still held, bytes, by device and inode: a program
    # may give back all of a mapping but a page, and the pages stay.
    _mappings: dict[bytes, int] = field(default_factory=dict)

    def used(self, processes: Sequence[int], enough: int) -> int:
        """Return the memory that processes hold together, bytes.

        What they share is counted once. That is slow to find out, so it is done only where the
        plain sum, which is never smaller, is above `enough`.
        """
        unowned = _scratch(processes) + self._shared(processes) + _memory_files(processes)
        total = unowned + sum(map(_resident, processes))
        return total if total <= enough else _proportional(processes, unowned)

    def _shared(self, processes: Iterable[int]) -> int:
        """Bytes of shared memory without a name, mapped or not, once for all processes."""
        found: dict[bytes, int] = {}
        for process in processes:
            for line in _lines(process, "maps", _SHARED_MAPPING):
                if line.endswith(_SHARED_MAPPING):
                    span, _, offset, device, inode = line.split()[:5]
                    first, last = (int(end, 16) for end in span.split(b"-"))
                    key = device + inode
                    size = int(offset, 16) + last - first
                    found[key] = max(size, found.get(key, 0), self._mappings.get(key, 0))
        self._mappings = found
        return sum(found.values())


def _lines(process: int, name: str, word: bytes = b"") -> list[bytes]:
    """The lines of a file of a process; none where it cannot be read or does not hold a word."""
    with contextlib.suppress(OSError), open(f"/proc/{process}/{name}", "rb") as table:
        text = table.read()
        return text.splitlines() if word in text else []
    return []


def _table(process: int, name: str) -> dict[bytes, int]:
    """The lines `Name: 12 kB` of a file of a process, in bytes."""
    found = {}
    for line in _lines(process, name):
        words = line.split()
        if len(words) == 3 and words[2] == b"kB":
            found[words[0].rstrip(b":")] = 1024 * int(words[1])
    return found


def _resident(process: int) -> int:
    table = _table(process, "status")
    return sum(table.get(name, 0) for name in (b"VmRSS", b"VmSwap", b"VmPTE"))


def _proportional(processes: Iterable[int], unowned: int) -> int:
    """Memory with shares of what several hold; mapped files in memory are among `unowned`."""
    own, mapped = 0, 0
    for process in processes:
        if table := _table(process, "smaps_rollup"):
            own += sum(table.get(name, 0) for name in (b"Pss_Anon", b"Pss_File", b"SwapPss"))
            own += _table(process, "status").get(b"VmPTE", 0)
            mapped += table.get(b"Pss_Shmem", 0)
        else:
            own += _resident(process)
    return own + max(mapped, unowned)


def _scratch(processes: Iterable[int]) -> int:
    """Bytes in the scratch folders of a sandbox, as its processes see them; 0 outside of one."""
    for process in processes:
        root = f"/proc/{process}/root"
        with contextlib.suppress(OSError):
            if os.stat(root).st_dev == os.stat("/").st_dev:
                continue
            tables = [os.statvfs(root + folder) for folder in SCRATCH]
            return sum((table.f_blocks - table.f_bfree) * table.f_frsize for table in tables)
    return 0


def _memory_files(processes: Iterable[int]) -> int:
    """Bytes of files that exist in memory alone (memfd_create), once for all processes."""
    sizes: dict[tuple[int, int], int] = {}
    for process in processes:
        folder = f"/proc/{process}/fd"
        with contextlib.suppress(OSError):
            for name in os.listdir(folder):
                with contextlib.suppress(OSError):
                    if os.readlink(f"{folder}/{name}").startswith(_MEMORY_FILE):
                        status = os.stat(f"{folder}/{name}")
                        sizes[status.st_dev, status.st_ino] = 512 * status.st_blocks
    return sum(sizes.values())


# --- control groups


@dataclass(frozen=True)
class ControlGroup:
    """A group of processes whose memory the kernel limits; it also counts what no process holds."""

    folder: Path

    def kills(self) -> int:
        """Return how many of its processes the kernel has ended, because they took too much."""
        return _kills(self.folder / "memory.events")

    def remove(self) -> None:
        """Remove it; its processes must have ended."""
        # The kernel may still be at work on the last one.
        for _ in range(50):
            with contextlib.suppress(OSError):
                self.folder.rmdir()
            if not self.folder.is_dir():
                return
            time.sleep(0.02)


def control_group(
    limit: int, process: int, mounted: Path | None = None, own: str | None = None
) -> ControlGroup | None:
    """Put a process into a new group, with all that it starts; None where there can be none.

    Only the second edition of control groups is used (cgroup v2).
    """
    if own is None:
        own = ""
        with contextlib.suppress(OSError), open("/proc/self/cgroup") as table:
            own = table.read()
    for above in _above(mounted or _CONTROL, own):
        # Those that killed runs have left; one with processes in it stays.
        for left in above.glob(f"{_PREFIX}*"):
            with contextlib.suppress(OSError):
                # A new one is empty until its first process comes.
                if time.time() - left.stat().st_mtime > _NEW_SECONDS:
                    left.rmdir()
        group = ControlGroup(above / f"{_PREFIX}{secrets.token_hex(6)}")
        try:
            group.folder.mkdir()
            (group.folder / "memory.max").write_text(str(limit))
            for name, value in (("memory.swap.max", "0"), ("memory.oom.group", "1")):
                with contextlib.suppress(OSError):
                    (group.folder / name).write_text(value)
            (group.folder / "cgroup.procs").write_text(str(process))
        except OSError:
            group.remove()
        else:
            return group
    return None


def _above(mounted: Path, own: str) -> Iterable[Path]:
    """Folders in which a group of its own may be possible, best first.

    A group that holds processes has no limited groups in it, so that a new one stands next to this
    process's own.
    """
    for line in own.splitlines():
        if line.startswith("0::/"):
            here = mounted / line[4:]
            for folder in (here, here.parent):
                if folder.is_relative_to(mounted) and ".." not in folder.parts:
                    with contextlib.suppress(OSError):
                        if "memory" in (folder / "cgroup.subtree_control").read_text().split():
                            yield folder
