"""Memory limits hold for what no process holds, and a kill for memory says so.

Oracle: the message of the run, and files that imitate the kernel's. Every method here gives itself
up after a bounded amount, so that a limit that does not hold harms nobody.
"""

from __future__ import annotations

import os
import sys
from pathlib import Path

import pytest

from hwp_bench.base.errors import MethodFailed
from hwp_bench.run.sandbox import supervise
from hwp_bench.run.sandbox import supervise as memory
from hwp_bench.run.sandbox.confinement import Confinement
from hwp_bench.run.sandbox.supervise import ControlGroup, Measure, control_group, scratch_bytes

pytestmark = pytest.mark.skipif(sys.platform != "linux", reason="process control is Linux's")
LIMIT = 200_000_000
# Each takes at most 400 MB and says `reached` if it got it all.
HOLDERS = {
    "memory file": """
import ctypes
try:
    handle = os.memfd_create("x")
except OSError:
    raise SystemExit("refused")
for _ in range(400):
    os.write(handle, bytes(1_000_000))
""",
    "scratch folders": """
for folder in ("/tmp", "/var/tmp", "/dev/shm"):
    with open(folder + "/filled", "wb") as stream:
        for _ in range(133):
            stream.write(bytes(1_000_000))
""",
    "deleted scratch": """
held = []
for folder in ("/tmp", "/var/tmp", "/dev/shm"):
    held.append(os.open(folder, os.O_TMPFILE | os.O_RDWR))
    for _ in range(133):
        os.write(held[-1], bytes(1_000_000))
""",
    "nested tmpfs": """
import ctypes
libc = ctypes.CDLL(None, use_errno=True)
user, group = os.getuid(), os.getgid()
if libc.unshare(0x10020000) == -1:
    raise SystemExit("refused")
for name, text in (("uid_map", f"{user} {user} 1"), ("setgroups", "deny"),
                   ("gid_map", f"{group} {group} 1")):
    open(f"/proc/self/{name}", "w").write(text)
if libc.mount(b"t", b"/tmp", b"tmpfs", 0, b"size=1g") == -1:
    raise SystemExit("refused")
with open("/tmp/filled", "wb") as stream:
    for _ in range(400):
        stream.write(bytes(1_000_000))
""",
    "shared mapping": """
import mmap, ctypes
held = mmap.mmap(-1, 400_000_000)
for place in range(0, len(held), 1_000_000):
    held[place:place + 1_000_000] = bytes(1_000_000)
    held.madvise(mmap.MADV_DONTNEED)  # the pages stay, and nobody has them mapped
""",
    "segment": """
import ctypes
libc = ctypes.CDLL(None, use_errno=True)
if libc.shmget(0, 400_000_000, 0o1600) == -1:
    raise SystemExit("refused")
""",
    "children": """
for _ in range(4):
    if os.fork() == 0:
        held = bytearray(os.urandom(1)) * 100_000_000
        time.sleep(60)
os.wait()
""",
}


@pytest.mark.parametrize("kind", sorted(HOLDERS))
def test_no_kind_of_memory_is_free(attack, kind: str) -> None:
    script = HOLDERS[kind] + "\ntime.sleep(2)\nprint('\"reached\"')\n"
    with pytest.raises(MethodFailed) as caught:
        attack(script, memory_limit=LIMIT, time_limit=60.0)
    ends = "took more than 0.2 GB of memory", "exit status 1"
    assert any(end in str(caught.value) for end in ends), caught.value


def test_what_stays_in_the_limit_goes_on(attack) -> None:
    script = """
import mmap
held = mmap.mmap(-1, 60_000_000)
held[:] = bytes(60_000_000)
with open("/tmp/filled", "wb") as stream:
    stream.write(bytes(40_000_000))
time.sleep(0.5)
print('"reached"')
"""
    _, said = attack(script, memory_limit=LIMIT)
    assert said == "reached"


@pytest.mark.parametrize("mode", ["required", "none"])
def test_a_kill_by_the_kernel_is_named(attack, monkeypatch: pytest.MonkeyPatch, mode: str) -> None:
    """The kernel's own count of such kills rises while the program runs."""
    counts = iter([3, 4])
    monkeypatch.setattr(memory, "kernel_kills", lambda: next(counts))
    with pytest.raises(MethodFailed, match="killed by SIGKILL; the kernel ended processes") as one:
        attack("os.kill(os.getpid(), 9)", mode)
    assert "--memory-limit" in str(one.value)


def test_a_machine_without_memory_stops_the_method(attack, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(memory, "machine_is_short", lambda: True)
    with pytest.raises(MethodFailed, match="because the machine's memory ran out") as caught:
        attack("time.sleep(60)", "none")
    assert "run fewer jobs at once" in str(caught.value)


def test_the_default_leaves_what_others_hold(monkeypatch: pytest.MonkeyPatch) -> None:
    import psutil

    class Free:
        available, total = 10_000_000_000, 100_000_000_000

    monkeypatch.setattr(psutil, "virtual_memory", Free)
    monkeypatch.setattr(memory, "_CONTROL", Path("/nowhere"))
    assert Confinement().memory_bytes == 9_000_000_000
    assert Confinement(memory_limit=5).memory_bytes == 5
    assert not memory.machine_is_short()
    monkeypatch.setattr(Free, "available", 200_000_000)
    assert memory.machine_is_short()


def test_the_default_knows_a_containers_share(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "memory.max").write_text("2000000000\n")
    (tmp_path / "memory.current").write_text("1500000000\n")
    monkeypatch.setattr(memory, "_CONTROL", tmp_path)
    assert Confinement().memory_bytes <= 450_000_000
    (tmp_path / "memory.max").write_text("max\n")
    assert Confinement().memory_bytes > 0


def test_scratch_folders_are_a_part_of_the_limit() -> None:
    assert scratch_bytes(LIMIT) == LIMIT // 4
    assert scratch_bytes(10**12) == 1 << 30


def test_shared_memory_counts_once_and_is_not_forgotten(monkeypatch: pytest.MonkeyPatch) -> None:
    """Giving back all of a mapping but its first page does not give back the pages."""
    whole = b"1000-4001000 rw-s 00000000 00:01 77 /dev/zero (deleted)\n"
    page = b"1000-2000 rw-s 00000000 00:01 77 /dev/zero (deleted)\n"
    tables = {1: whole, 2: whole}
    monkeypatch.setattr(
        memory, "_lines", lambda process, name, word=b"": tables[process].splitlines()
    )
    measure = Measure()
    assert measure._shared([1, 2]) == 0x4000000
    tables.update({1: page, 2: page})
    assert measure._shared([1, 2]) == 0x4000000
    tables.update({1: b"", 2: b""})
    assert measure._shared([1, 2]) == 0


def test_a_control_group_is_made_where_there_can_be_one(tmp_path: Path) -> None:
    """Oracle: the kernel's documents (Control Group v2); the files here are plain ones."""
    shell = tmp_path / "user.slice" / "shell.scope"
    shell.mkdir(parents=True)
    assert control_group(LIMIT, 12, tmp_path, "0::/user.slice/shell.scope\n") is None
    (shell.parent / "cgroup.subtree_control").write_text("cpu memory pids\n")
    group = control_group(LIMIT, 12, tmp_path, "0::/user.slice/shell.scope\n")
    assert group is not None
    assert group.folder.parent == shell.parent
    assert (group.folder / "memory.max").read_text() == str(LIMIT)
    assert (group.folder / "memory.swap.max").read_text() == "0"
    old = shell.parent / "hwp-bench-old"
    old.mkdir()
    os.utime(old, (0, 0))
    control_group(LIMIT, 13, tmp_path, "0::/user.slice/shell.scope\n")
    assert not old.exists()
    assert (group.folder / "cgroup.procs").read_text() == "12"
    assert group.kills() == 0
    (group.folder / "memory.events").write_text("low 0\noom 1\noom_kill 2\n")
    assert group.kills() == 2
    assert control_group(LIMIT, 12, tmp_path, "0::/../../elsewhere\n") is None


def test_a_kill_in_a_control_group_is_the_limit(attack, monkeypatch, tmp_path: Path) -> None:
    (tmp_path / "group").mkdir()
    (tmp_path / "group" / "memory.events").write_text("oom_kill 1\n")
    group = ControlGroup(tmp_path / "group")
    monkeypatch.setattr(supervise, "control_group", lambda limit, process: group)
    with pytest.raises(MethodFailed, match=r"took more than 0\.2 GB of memory"):
        attack("os.kill(os.getpid(), 9)", "none", memory_limit=LIMIT)
