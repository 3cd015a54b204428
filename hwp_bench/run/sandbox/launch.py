"""The process between the toolkit and an untrusted program: builds the sandbox, then waits.

A bare interpreter (`-I -S`) runs it, for speed, so it imports nothing heavy. Its order comes as
JSON on standard input, so that the program finds nothing of it; its report goes to a descriptor
that the program does not inherit.
"""

from __future__ import annotations

import contextlib
import fcntl
import json
import os
import resource
import signal
import socket
import struct
import sys
import time
from collections.abc import Sequence
from typing import Any, NoReturn

from hwp_bench.run.sandbox import syscalls
from hwp_bench.run.sandbox.syscalls import refuse_calls

# A folder that exists everywhere; its content is bound out of the old root.
_STAGE = "/tmp"
_OLD, _NEW = "/old", "/new"
#: One place: kind, path, and a third word that is empty for most. The kinds are `read` and `write`
#: (the place as it is, read-only or writable), `hidden` (an empty folder), `scratch` (a private
#: writable folder; the third word is its size, bytes), `link` (a symbolic link; its target) and
#: `proc` (the process table, read-only).
Place = tuple[str, str, str]
_NAMESPACES = syscalls.CLONE_NEWUSER | syscalls.CLONE_NEWNS | syscalls.CLONE_NEWPID
_NAMESPACES |= syscalls.CLONE_NEWNET | syscalls.CLONE_NEWIPC
_QUIET = syscalls.MS_NOSUID | syscalls.MS_NODEV
# Most seconds that are spent on ending descendants; a storm of forks could last for ever.
_PATIENCE = 5.0


def main(report: int) -> None:
    """Carry out one order.

    The order holds `command`, `folder`, `environment`, `parent` (process id of whoever waits),
    `places` (null for a run without namespaces) and `memory_files` (whether `memfd_create` stays).
    The report is one JSON object: `status` (an exit
    status, or a signal's number below 0), or `problem` with `stage` (`sandbox` or `command`).
    """
    order = json.loads(sys.stdin.buffer.read())
    os.set_inheritable(report, False)
    # A program reaches the first process of its sandbox by signals that have a handler there.
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    with open(os.devnull, "r+b", buffering=0) as silence:
        os.dup2(silence.fileno(), 0)
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
    # The kernel ends the method first, not the toolkit, when the machine's memory runs out.
    with contextlib.suppress(OSError), open("/proc/self/oom_score_adj", "w") as stream:
        stream.write("1000")
    # Where the system has no keys or forbids the call, there is nothing to be left behind.
    with contextlib.suppress(OSError):
        syscalls.leave_session_keyring()
    try:
        answer = _run_watched(order) if order["places"] is None else _run_in_namespaces(order)
    except OSError as error:
        answer = {"stage": "sandbox", "problem": str(error.args[-1])}
    os.write(report, json.dumps(answer).encode())


def _run_watched(order: dict[str, Any]) -> dict[str, Any]:
    """Run the command as a plain child; its descendants die with it."""
    linux = sys.platform == "linux"
    if linux:
        syscalls.adopt_orphans()
        syscalls.die_with_parent(signal.SIGTERM)
        syscalls.hide_from_peers()
    # Set before the child exists: its end must never be a question of timing.
    signal.signal(signal.SIGTERM, _end_all)
    if os.getppid() != order["parent"]:
        raise OSError("the process that asked for the run is gone")
    child, problem = _start(order)
    if problem:
        return {"stage": "command", "problem": problem}
    status = _wait(child)
    if linux:
        _end_descendants()
    return {"status": status}


def _end_all(*_: object) -> NoReturn:
    signal.signal(signal.SIGTERM, signal.SIG_IGN)
    if sys.platform == "linux":
        _end_descendants()
    os._exit(1)


def _run_in_namespaces(order: dict[str, Any]) -> dict[str, Any]:
    """Run the command in namespaces of its own; the kernel ends them with their first process."""
    user, group = os.getuid(), os.getgid()
    syscalls.unshare(_NAMESPACES)
    for name, text in (
        ("setgroups", "deny"),
        ("uid_map", f"{user} {user} 1"),
        ("gid_map", f"{group} {group} 1"),
    ):
        with open(f"/proc/self/{name}", "w") as table:
            table.write(text)
    syscalls.die_with_parent(signal.SIGKILL)
    if os.getppid() != order["parent"]:
        raise OSError("the process that asked for the run is gone")
    go_read, go_write = os.pipe()
    answer_read, answer_write = os.pipe()
    first = os.fork()
    if first == 0:
        os.close(go_write)
        os.close(answer_read)
        _be_first(order, go_read, answer_write)
    os.close(go_read)
    os.close(answer_write)
    os.write(go_write, b"!")
    with os.fdopen(answer_read, "rb") as answer:
        said = answer.read()
    status = _wait(first)
    return json.loads(said) if said else {"status": status}


def _be_first(order: dict[str, Any], go: int, answer: int) -> NoReturn:
    """Do the work of the first process of the new process namespace; never returns."""
    result: dict[str, Any] = {"stage": "sandbox", "problem": "failed"}
    try:
        syscalls.die_with_parent(signal.SIGKILL)
        # Nothing comes where the parent had ended before the line above.
        if not os.read(go, 1):
            os._exit(1)
        os.close(go)
        enter_root(order["places"])
        with contextlib.suppress(OSError):
            raise_loopback()
        syscalls.give_up_privileges()
        syscalls.hide_from_peers()
        refuse_calls(memory_files=order["memory_files"])
        child, problem = _start(order)
        if problem:
            result = {"stage": "command", "problem": problem}
        else:
            # Whatever fails from here on is not the system's refusal, after which the program
            # would be started again without a sandbox.
            result = {"status": 1}
            result = {"status": _wait(child)}
    except OSError as error:
        if "status" not in result:
            result = {"stage": "sandbox", "problem": str(error.args[-1])}
    finally:
        os.write(answer, json.dumps(result).encode())
        os._exit(0)


def _start(order: dict[str, Any]) -> tuple[int, str]:
    """Start the command; returns its process id, and the problem where it cannot be started."""
    read, write = os.pipe()
    child = os.fork()
    if child == 0:
        try:
            # Python ignores some signals, and what is ignored stays so in the new program.
            for name in ("SIGINT", "SIGTERM", "SIGPIPE", "SIGXFSZ"):
                signal.signal(getattr(signal, name), signal.SIG_DFL)
            os.chdir(order["folder"])
            os.execvpe(order["command"][0], order["command"], order["environment"])
        except OSError as error:
            os.write(write, (error.strerror or "unknown reason").encode())
        finally:
            os._exit(127)
    os.close(write)
    with os.fdopen(read, "rb") as stream:
        problem = stream.read().decode()
    if problem:
        os.waitpid(child, 0)
    return child, problem


def _wait(child: int) -> int:
    """Wait for one child, and collect the orphans that end meanwhile."""
    while True:
        process, status = os.waitpid(-1, 0)
        if process == child:
            return os.waitstatus_to_exitcode(status)


def _end_descendants() -> None:
    """Kill children and their children until none is left.

    The process must have adopted its orphans, or those are out of reach.
    """
    deadline = time.monotonic() + _PATIENCE
    while time.monotonic() < deadline:
        family = _descendants(os.getpid())
        for process in family:
            with contextlib.suppress(ProcessLookupError, PermissionError):
                os.kill(process, signal.SIGKILL)
        try:
            while os.waitpid(-1, os.WNOHANG)[0]:
                pass
        except ChildProcessError:
            return
        time.sleep(0.005)


def _descendants(root: int) -> list[int]:
    children: dict[int, list[int]] = {}
    for name in os.listdir("/proc"):
        if name.isdigit():
            with contextlib.suppress(OSError, ValueError, IndexError):
                with open(f"/proc/{name}/stat", "rb") as stream:
                    # The name in brackets may hold anything; the parent is two words after it.
                    parent = int(stream.read().rpartition(b")")[2].split()[1])
                children.setdefault(parent, []).append(int(name))
    found, new = [], [root]
    while new:
        new = [child for parent in new for child in children.get(parent, [])]
        found += new
    return found


# --- a root in which only the places that are shown exist. The order of steps is bubblewrap's:
# the new root grows on a tmpfs, the old one is moved below it with pivot_root(2) while places are
# bound out of it, and then detached


def enter_root(places: Sequence[Place]) -> None:
    """Move this process into a root that shows the given places only.

    It must be in a mount namespace of its own, and the first process of its process namespace.
    """
    syscalls.mount("", "/", "", syscalls.MS_REC | syscalls.MS_SLAVE)
    _tmpfs(_STAGE, "size=16m,mode=755")
    for name in (_OLD, _NEW):
        os.mkdir(_STAGE + name)
    _tmpfs(_STAGE + _NEW, "size=16m,mode=755")
    syscalls.pivot_root(_STAGE, _STAGE + _OLD)
    os.chdir("/")
    # A hidden folder is one only where a place that is shown contains it.
    masks = [path for place in places if (path := _show(place))]
    # Not before now: places inside a hidden folder that are shown need mount points.
    for path in masks:
        _restrict(path)
    syscalls.unmount(_OLD)
    os.chdir(_NEW)
    # The known way to drop the outer root: stack it on the new one, and detach it.
    syscalls.pivot_root(".", ".")
    syscalls.unmount(".")
    os.chdir("/")
    _restrict("/")


def _show(place: Place) -> str | None:
    """Show one place; returns the folder that was hidden, if one was."""
    kind, path, target = place
    here, there = _NEW + path, _OLD + path
    if kind == "link":
        if not os.path.lexists(here):
            os.makedirs(os.path.dirname(here), exist_ok=True)
            os.symlink(target, here)
    elif kind in ("read", "write"):
        _mount_point(here, folder=os.path.isdir(there))
        syscalls.mount(there, here, "", syscalls.MS_BIND | syscalls.MS_REC)
        attributes = syscalls.MOUNT_ATTR_NOSUID
        if kind == "read":
            attributes |= syscalls.MOUNT_ATTR_RDONLY
        syscalls.set_attributes(here, attributes)
    elif kind == "proc":
        os.makedirs(here, exist_ok=True)
        syscalls.mount("proc", here, "proc", _QUIET)
        _restrict_machine(here)
    elif kind == "scratch":
        os.makedirs(here, exist_ok=True)
        _tmpfs(here, f"size={target},mode=1777")
    elif os.path.isdir(here):
        _tmpfs(here, "size=1m,mode=755")
        return here
    return None


def _restrict_machine(proc: str) -> None:
    """Make everything read-only in a process table but its processes.

    Its files decide by the user's number alone, whatever rights are left: started by root, the
    program could write the whole machine's settings. What covers a part of it also keeps a user
    namespace made inside from mounting another that is whole. Processes stay writable, because
    threads are named there, which CUDA cannot begin without.
    """
    for entry in os.scandir(proc):
        if not entry.name.isdigit() and not entry.is_symlink():
            syscalls.mount(entry.path, entry.path, "", syscalls.MS_BIND | syscalls.MS_REC)
            syscalls.set_attributes(entry.path, syscalls.MOUNT_ATTR_RDONLY)


def _mount_point(path: str, *, folder: bool) -> None:
    if folder:
        os.makedirs(path, exist_ok=True)
    elif not os.path.lexists(path):
        os.makedirs(os.path.dirname(path), exist_ok=True)
        os.close(os.open(path, os.O_CREAT | os.O_WRONLY, 0o644))


def _tmpfs(path: str, options: str) -> None:
    syscalls.mount("tmpfs", path, "tmpfs", _QUIET, options)


def _restrict(path: str) -> None:
    syscalls.set_attributes(path, syscalls.MOUNT_ATTR_RDONLY, recursive=False)


def raise_loopback() -> None:
    """Switch on `lo`, the only interface of a new network namespace: it leads nowhere else."""
    siocsifflags, up = 0x8914, 0x1
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as handle:
        fcntl.ioctl(handle, siocsifflags, struct.pack("16sh22x", b"lo", up))
