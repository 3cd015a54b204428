"""How much memory a program and its children hold, what they may hold, and who enforces it.

Where this user may make a memory control group, the kernel counts and enforces. Everywhere else
the memory is measured, from outside and several times a second: what processes hold, and what no
process need hold, which are files of the scratch folders, memory files and shared mappings.
"""

from __future__ import annotations

import contextlib
import os
import secrets
import time
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from pathlib import Path

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
    with contextlib.suppress(OSError, ValueError), open("/proc/vmstat") as table:
        for line in table:
            name, _, count = line.partition(" ")
            if name == "oom_kill":
                return int(count)
    return 0


def offer_to_kernel(processes: Iterable[int]) -> None:
    """Have the kernel end these processes first, and not others, when memory runs out.

    They may take it back, so that it is said again whenever they are looked at.
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

        Args:
            processes: their numbers.
            enough: bytes.
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
        table = _table(process, "smaps_rollup")
        if table:
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


@dataclass(frozen=True)
class ControlGroup:
    """A group of processes whose memory the kernel limits; it also counts what no process holds."""

    #: Its folder.
    folder: Path

    def take(self, process: int) -> None:
        """Put a process into it, and with it all that it starts."""
        (self.folder / "cgroup.procs").write_text(str(process))

    def kills(self) -> int:
        """Return how many of its processes the kernel has ended, because they took too much."""
        with contextlib.suppress(OSError, ValueError):
            for line in (self.folder / "memory.events").read_text().splitlines():
                name, _, count = line.partition(" ")
                if name == "oom_kill":
                    return int(count)
        return 0

    def remove(self) -> None:
        """Remove it; its processes must have ended."""
        # The kernel may still be at work on the last one.
        for _ in range(50):
            try:
                self.folder.rmdir()
            except FileNotFoundError:
                return
            except OSError:
                time.sleep(0.02)
            else:
                return


def control_group(
    limit: int, mounted: Path = _CONTROL, own: str | None = None
) -> ControlGroup | None:
    """Make a control group for one run; None where this user or system has none.

    Only the second edition of control groups is used (cgroup v2).

    Args:
        limit: most memory of its processes, bytes.
        mounted: where control groups are mounted.
        own: content of `/proc/self/cgroup`; None reads it.
    """
    if own is None:
        own = ""
        with contextlib.suppress(OSError), open("/proc/self/cgroup") as table:
            own = table.read()
    for above in _above(mounted, own):
        _remove_old(above)
        group = ControlGroup(above / f"{_PREFIX}{secrets.token_hex(6)}")
        try:
            group.folder.mkdir()
            (group.folder / "memory.max").write_text(str(limit))
        except OSError:
            group.remove()
            continue
        for name, value in (("memory.swap.max", "0"), ("memory.oom.group", "1")):
            with contextlib.suppress(OSError):
                (group.folder / name).write_text(value)
        return group
    return None


def _remove_old(above: Path) -> None:
    """Remove groups that killed runs have left; one with processes in it stays."""
    for folder in above.glob(f"{_PREFIX}*"):
        with contextlib.suppress(OSError):
            # A new one is empty until its first process comes.
            if time.time() - folder.stat().st_mtime > _NEW_SECONDS:
                folder.rmdir()


def _above(mounted: Path, own: str) -> Iterable[Path]:
    """Folders in which a group of its own may be possible, best first.

    A group that holds processes has no limited groups in it, so that a new one stands next to this
    process's own.
    """
    for line in own.splitlines():
        if line.startswith("0::/"):
            here = mounted / line[4:]
            for folder in (here, here.parent):
                inside = folder.is_relative_to(mounted) and ".." not in folder.parts
                if inside and _limits_memory(folder):
                    yield folder


def _limits_memory(folder: Path) -> bool:
    with contextlib.suppress(OSError):
        return "memory" in (folder / "cgroup.subtree_control").read_text().split()
    return False
