"""No setting of the machine can be written inside the walls, by root neither.

Oracle: what access(2) answers inside. Nothing is opened or written.
"""

from __future__ import annotations

from pathlib import Path

import pytest
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


def test_a_namespace_made_inside_mounts_no_writable_process_table(tmp_path: Path) -> None:
    # It gives capabilities in itself, and the user's number outside stays what it was.
    script = """
import ctypes
libc = ctypes.CDLL(None, use_errno=True)
made = libc.unshare(0x10000000 | 0x00020000 | 0x20000000)  # user, mounts, processes
here, there = os.pipe()
if os.fork() == 0:
    os.mkdir("/tmp/proc")
    mounted = libc.mount(b"proc", b"/tmp/proc", b"proc", 0, None)
    changed = libc.mount(None, b"/proc", None, 0x1020, None)  # remount, bind: writable again
    found = writable("/tmp/proc/sys") + writable("/proc/sys")
    os.write(there, json.dumps([mounted, changed, found[:5]]).encode())
    os._exit(0)
os.wait()
print(json.dumps({"made": made, "got": json.loads(os.read(here, 10_000))}))
"""
    said = run_walled(tmp_path, WRITABLE + script)
    if said["made"] == -1:
        pytest.skip("no user namespaces inside user namespaces on this machine")
    assert said["got"] == [-1, -1, []]
