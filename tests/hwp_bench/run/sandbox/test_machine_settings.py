"""No setting of the machine can be written inside the walls, by root neither.

Oracle: what access(2) answers inside. Nothing is opened or written.
"""

from __future__ import annotations

from pathlib import Path

from walled_script import run_walled

WRITABLE = """
if os.path.exists("/etc/shadow"):
    raise SystemExit("no sandbox, so nothing is tried")
def writable(top):
    # access(2) answers, so that nothing is opened or written.
    found = []
    for folder, folders, files in os.walk(top):
        folders[:] = [name for name in folders if not (folder == "/proc" and name.isdigit())]
        found += [path for name in files if os.access(path := os.path.join(folder, name), os.W_OK)]
    return found
"""


def test_no_setting_of_the_machine_can_be_written(tmp_path: Path) -> None:
    """For root as for anybody else; the reliability page counted 763 writable ones as root."""
    script = """
print(json.dumps({"proc": writable("/proc")[:5], "sys": writable("/sys")[:5],
    "seen": os.listdir("/proc/sys"), "cores": os.path.isdir("/sys/devices/system/cpu"),
    "tracing": os.path.exists("/sys/kernel/tracing"),
    "firmware": os.path.exists("/sys/firmware")}))
"""
    said = run_walled(tmp_path, WRITABLE + script)
    assert said["proc"] == []
    assert said["sys"] == []
    assert said["seen"]
    assert said["cores"]
    assert not said["tracing"]
    assert not said["firmware"]


def test_a_thread_can_be_named_from_another(tmp_path: Path) -> None:
    """As glibc's pthread_setname_np does; CUDA does not begin where it fails (error 304)."""
    script = """
import threading
done = threading.Event()
thread = threading.Thread(target=done.wait)
thread.start()
comm = f"/proc/self/task/{thread.native_id}/comm"
with open(comm, "w") as file:
    file.write("named")
with open(comm) as file:
    print(json.dumps(file.read().strip()))
done.set()
"""
    assert run_walled(tmp_path, script) == "named"


def test_no_namespace_and_no_mount_is_made_inside(tmp_path: Path) -> None:
    """A user namespace would give capabilities in itself, and with them memory without a limit."""
    script = """
import ctypes
libc = ctypes.CDLL(None, use_errno=True)
def number(result):
    return ctypes.get_errno() if result == -1 else 0
made = [number(libc.unshare(0x10000000 | more)) for more in (0, 0x00020000 | 0x20000000)]
cloned = number(libc.syscall(56 if os.uname().machine == "x86_64" else 220, 0x10000011, 0, 0, 0, 0))
newer = number(libc.syscall(435, 0, 0))
mounted = number(libc.mount(b"tmpfs", b"/tmp", b"tmpfs", 0, None))
print(json.dumps({"made": made, "cloned": cloned, "newer": newer, "mounted": mounted}))
"""
    said = run_walled(tmp_path, script)
    assert said == {"made": [1, 1], "cloned": 1, "newer": 38, "mounted": 1}  # EPERM, ENOSYS
