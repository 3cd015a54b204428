"""A root of its own for a program: only the places that are shown exist in it.

The order of steps is bubblewrap's: the new root grows on a tmpfs, the old one is moved below it
with pivot_root(2) while places are bound out of it, and then detached.
"""

from __future__ import annotations

import fcntl
import os
import socket
import struct
from collections.abc import Sequence

from hwp_bench.run.sandbox import syscalls

# A folder that exists everywhere; its content is bound out of the old root.
_STAGE = "/tmp"
_OLD, _NEW = "/old", "/new"

#: One place: kind, path, and a third word that is empty for most. The kinds are `read` and `write`
#: (the place as it is, read-only or writable), `hidden` (an empty folder), `scratch` (a private
#: writable folder; the third word is its size, bytes), `link` (a symbolic link; its target) and
#: `proc` (the process table, read-only).
Place = tuple[str, str, str]


def enter_root(places: Sequence[Place]) -> None:
    """Move this process into a root that shows the given places only.

    It must be in a mount namespace of its own, and the first process of its process namespace.

    Args:
        places: sorted so that outer ones come first; paths are absolute, and free of symbolic
            links apart from those that are places themselves.

    Raises:
        Refused: the system does not allow a step.
        OSError: a mount point cannot be made.
    """
    quiet = syscalls.MS_NOSUID | syscalls.MS_NODEV
    syscalls.mount("", "/", "", syscalls.MS_REC | syscalls.MS_SLAVE)
    syscalls.mount("tmpfs", _STAGE, "tmpfs", quiet, "size=16m,mode=755")
    for name in (_OLD, _NEW):
        os.mkdir(_STAGE + name)
    syscalls.mount("tmpfs", _STAGE + _NEW, "tmpfs", quiet, "size=16m,mode=755")
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
        syscalls.mount("proc", here, "proc", syscalls.MS_NOSUID | syscalls.MS_NODEV)
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
    syscalls.mount("tmpfs", path, "tmpfs", syscalls.MS_NOSUID | syscalls.MS_NODEV, options)


def _restrict(path: str) -> None:
    syscalls.set_attributes(path, syscalls.MOUNT_ATTR_RDONLY, recursive=False)


def raise_loopback() -> None:
    """Switch on `lo`, the only interface of a new network namespace: it leads nowhere else."""
    siocsifflags, up = 0x8914, 0x1
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as handle:
        fcntl.ioctl(handle, siocsifflags, struct.pack("16sh22x", b"lo", up))
