"""Attacks on the walls, each in a few lines, all in one run of a method inside them.

Nothing that they try would do harm if it succeeded. Oracle: what each call answers there.
"""

from __future__ import annotations

import os
import socket
import sys
from pathlib import Path
from typing import Any

import pytest
from walled_script import run_walled

from hwp_bench.base.files import cache_root

pytestmark = pytest.mark.skipif(sys.platform != "linux", reason="walls are Linux's")

HEAD = """
import ctypes, errno, socket, struct
if os.path.exists("/etc/shadow"):
    raise SystemExit("no sandbox, so nothing is tried")
libc = ctypes.CDLL(None, use_errno=True)
libc.syscall.restype = ctypes.c_long
X86 = os.uname().machine == "x86_64"
said = {}
def call(number, *words):
    ctypes.set_errno(0)
    words = [ctypes.c_long(word) if isinstance(word, int) else word for word in words]
    result = libc.syscall(ctypes.c_long(number), *words)
    return errno.errorcode[ctypes.get_errno()] if result == -1 else f"done {result}"
def attempt(name, function):
    try:
        answer = function()
    except OSError as error:
        answer = errno.errorcode.get(error.errno, str(error))
    said[name] = answer if isinstance(answer, str) else f"done {answer}"
def number(x86, other):
    return x86 if X86 else other
def write(path):
    with open(path, "w") as stream:
        stream.write("0")
BUFFER = ctypes.create_string_buffer(8)
VECTOR = struct.pack("QQ", ctypes.addressof(BUFFER), 8)
output = sys.argv[2]
"""

#: Name: the attack, and the answers that are no success. `gone` says that there is no such thing.
ATTACKS: dict[str, tuple[str, set[str]]] = {
    # Reading.
    "root of the first process": ('os.listdir("/proc/1/root")', {"EACCES", "EPERM"}),
    "folder of the first process": ('os.listdir("/proc/1/cwd")', {"EACCES", "EPERM"}),
    "memory of the first process": ('open("/proc/1/mem", "rb").read(1)', {"EACCES", "EPERM"}),
    "ptrace of the first process": ("call(number(101, 117), 16, 1, 0, 0)", {"EPERM"}),
    "reading its memory by call": ("call(number(310, 270), 1, VECTOR, 1, VECTOR, 1, 0)", {"EPERM"}),
    "a descriptor of the first process": ("call(438, os.pidfd_open(1), 0, 0)", {"EPERM"}),
    "files by handle": ("call(number(304, 265), -100, b'\\0' * 160, 0)", {"EPERM"}),
    "the kernel's messages": ("call(number(103, 116), 3, b'\\0' * 64, 64)", {"EPERM"}),
    "another root": ('os.chroot("/usr")', {"EPERM"}),
    "the disk": ('open("/dev/vda", "rb").read(1)', {"ENOENT"}),
    "the machine's memory": ('open("/dev/mem", "rb").read(1)', {"ENOENT"}),
    "the terminal": ('open("/dev/tty", "rb").read(1)', {"ENOENT", "ENXIO"}),
    "the caller's sockets": ('os.listdir("/run/user")', {"ENOENT"}),
    # Writing.
    "a read-only file opened again": (
        'open(f"/proc/self/fd/{os.open(__file__, os.O_RDONLY)}", "r+b").write(b"x")',
        {"EROFS"},
    ),
    "modes of its own files": ("os.chmod(__file__, 0o777)", {"EROFS"}),
    "a hard link out of its folder": ("os.link(__file__, output + '/linked')", {"EXDEV", "EROFS"}),
    "attributes of programs": ('os.setxattr("/usr", "user.x", b"x")', {"EROFS"}),
    "its output moved away": ("os.rename(output, output + '.old')", {"EBUSY", "EROFS", "EXDEV"}),
    "a bind mount": ('call(number(165, 40), b"/tmp", b"/usr", None, 0x1000, None)', {"EPERM"}),
    "a mount by descriptors": ('call(430, b"tmpfs", 0)', {"EPERM"}),
    "an attribute of a mount": ('call(442, -100, b"/usr", 0, b"\\0" * 32, 32)', {"EPERM"}),
    "a device": ('os.mknod("/tmp/disk", 0o60600, os.makedev(254, 0))', {"EPERM"}),
    "core dumps elsewhere": ('write("/proc/sys/kernel/core_pattern")', {"EROFS", "EACCES"}),
    "control groups": ('os.mkdir("/sys/fs/cgroup/mine")', {"EROFS", "EACCES", "ENOENT"}),
    "the host's name": ('socket.sethostname("mine")', {"EPERM"}),
    # Persisting.
    "set-user-id by a ring": ("call(425, 8, b'\\0' * 128)", {"ENOSYS"}),
    "set-user-id by openat2": (
        "call(437, -100, b'/tmp/tool', (0o4755).to_bytes(8, 'little') * 3, 24)",
        {"ENOSYS"},
    ),
    "set-user-id at birth": ("os.open('/tmp/tool', os.O_CREAT | os.O_WRONLY, 0o4755)", {"EPERM"}),
    "capabilities of a file": (
        "(open('/tmp/able', 'w'), os.setxattr('/tmp/able', 'security.capability',"
        " (0x02000001).to_bytes(4, 'little') + b'\\xff' * 16))[1]",
        {"EPERM"},
    ),
    "a shared segment": ("call(number(29, 194), 77, 4096, 0o1666)", {"ENOSYS"}),
    "a queue of messages": ("call(number(68, 186), 77, 0o1666)", {"ENOSYS"}),
    # Keys.
    "a key": ('call(number(248, 217), b"user", b"left", b"x", 1, -3)', {"ENOSYS"}),
    "reading a key": ("call(number(250, 219), 11, -3, b'\\0' * 64, 64)", {"ENOSYS"}),
    "asking for a key": ('call(number(249, 218), b"user", b"x", None, -3)', {"ENOSYS"}),
    # The world outside.
    "the host of a virtual machine": ("socket.socket(40, 1).fileno()", {"EAFNOSUPPORT"}),
    "raw frames": ("socket.socket(17, 3).fileno()", {"EAFNOSUPPORT"}),
    "the kernel's ciphers": ("socket.socket(38, 5).fileno()", {"EAFNOSUPPORT"}),
    "raw packets": ("socket.socket(2, 3, 1).fileno()", {"EPERM"}),
    "an abstract socket outside": (
        "socket.socket(socket.AF_UNIX).connect('\\0' + ABSTRACT)",
        {"ECONNREFUSED"},
    ),
    # Memory.
    "a secret memory file": ("call(447, 0)", {"ENOSYS"}),
    "faults in user space": ("call(number(323, 282), 0)", {"ENOSYS"}),
    "hiding from who measures": ("call(number(157, 167), 4, 0, 0, 0, 0)", {"EPERM"}),
    # Processes.
    "a user namespace": ("call(number(272, 97), 0x10000000)", {"EPERM"}),
    "a child in a namespace": ("call(number(56, 220), 0x10000011, 0, 0, 0, 0)", {"EPERM"}),
    "a child by the newer call": ("call(435, b'\\0' * 64, 64)", {"ENOSYS"}),
    "namespaces of the first process": (
        "call(number(308, 268), os.pidfd_open(1), 0x10000000)",
        {"EPERM"},
    ),
    "being somebody else": ("os.setuid(os.getuid() + 1)", {"EPERM", "EINVAL"}),
    "groups": ("os.setgroups([0])", {"EPERM"}),
    "priority over others": ("os.setpriority(os.PRIO_PROCESS, 0, -5)", {"EPERM", "EACCES"}),
    "real time": (
        "os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(1))",
        {"EPERM"},
    ),
    "programs of the kernel": ("call(number(321, 280), 0, b'\\0' * 64, 64)", {"ENOSYS"}),
    "counters of the machine": ("call(number(298, 241), b'\\0' * 64, 0, -1, -1, 0)", {"ENOSYS"}),
    "calls of the second table": ("call(0x40000000 | number(250, 0), 0, 0)", {"ENOSYS", "EACCES"}),
    # Caches.
    "code of the toolkit": ('write(os.environ["HWP_KERNELS"] + "/x.code")', {"EROFS", "ENOENT"}),
    # Of a cache below /tmp the walls show the kernels alone, in a folder of scratch files.
    "the toolkit's cache": (
        'write(os.path.dirname(os.environ["HWP_KERNELS"]) + "/left-by-an-attack")',
        {"EROFS", "ENOENT", "done None"},
    ),
    "packages of Python": ('write(os.path.dirname(json.__file__) + "/x.py")', {"EROFS"}),
}


@pytest.fixture(scope="module")
def answers(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Any]:
    """What each attack was answered, inside the walls."""
    body = "".join(
        f"attempt({name!r}, lambda: {script})\n" for name, (script, _) in ATTACKS.items()
    )
    abstract = f"hwp-bench-test-{os.getpid()}"
    with socket.socket(socket.AF_UNIX) as listener:
        listener.bind("\0" + abstract)
        listener.listen()
        script = f"ABSTRACT = {abstract!r}\n{HEAD}{body}print(json.dumps(said))\n"
        answer: dict[str, Any] = run_walled(tmp_path_factory.mktemp("attacks"), script)
    return answer


@pytest.mark.parametrize("name", sorted(ATTACKS))
def test_an_attack_is_refused(answers: dict[str, Any], name: str) -> None:
    assert answers[name] in ATTACKS[name][1]


def test_nothing_is_left_in_the_toolkits_cache(answers: dict[str, Any]) -> None:
    assert "the toolkit's cache" in answers
    assert not (cache_root() / "left-by-an-attack").exists()


def test_the_first_to_be_ended_stays_the_first(tmp_path: Path) -> None:
    """A method may say that the kernel should rather end others; the toolkit takes it back."""
    script = """
import time
place = "/proc/self/oom_score_adj"
before = open(place).read().strip()
try:
    with open(place, "w") as stream:
        stream.write("0")
except OSError:
    pass
deadline = time.monotonic() + 60
while open(place).read().strip() != "1000" and time.monotonic() < deadline:
    time.sleep(0.05)
print(json.dumps([before, open(place).read().strip()]))
"""
    assert run_walled(tmp_path, script) == ["1000", "1000"]


def test_calls_of_a_32_bit_program_are_refused(tmp_path: Path) -> None:
    """Their numbers are others, so that a filter by number alone would let them through."""
    script = """
import ctypes, mmap
answer = -38
if os.uname().machine == "x86_64":
    # mov eax, 20 (getpid of the 32-bit table); int 0x80; ret
    code = mmap.mmap(-1, 4096, prot=mmap.PROT_READ | mmap.PROT_WRITE | mmap.PROT_EXEC)
    code.write(bytes.fromhex("b814000000cd80c3"))
    place = ctypes.addressof(ctypes.c_char.from_buffer(code))
    answer = ctypes.CFUNCTYPE(ctypes.c_int)(place)()
print(json.dumps(answer))
"""
    assert run_walled(tmp_path, script) == -38


def test_honest_programs_are_not_disturbed(tmp_path: Path) -> None:
    """Threads, children, local sockets, shared memory of multiprocessing, copies of trees."""
    script = """
import multiprocessing, shutil, socket, subprocess, tempfile, threading
from multiprocessing import shared_memory
thread = threading.Thread(target=print, args=("thread",))
thread.start()
thread.join()
child = subprocess.run([sys.executable, "-c", "print(7)"], capture_output=True, text=True)
left, right = socket.socketpair()
left.send(b"x")
memory = shared_memory.SharedMemory(create=True, size=1000)
memory.buf[0] = 5
with multiprocessing.get_context("fork").Pool(2) as pool:
    squares = pool.map(abs, [-1, -2])
folder = tempfile.mkdtemp()
os.chmod(folder, 0o2755)  # as folders of groups have
shutil.copytree(folder, os.path.join(sys.argv[2], "copied"))
got = [child.stdout.strip(), right.recv(1).decode(), memory.buf[0], squares]
memory.unlink()
print(json.dumps(got))
"""
    assert run_walled(tmp_path, script) == ["7", "x", 5, [1, 2]]
