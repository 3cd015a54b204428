"""The Linux calls behind a sandbox, through ctypes: namespaces, mounts, capabilities.

It imports only the standard library, because every run of a method passes through here.
"""

from __future__ import annotations

import ctypes
import errno
import os

CLONE_NEWNS = 0x00020000
CLONE_NEWIPC = 0x08000000
CLONE_NEWUSER = 0x10000000
CLONE_NEWPID = 0x20000000
CLONE_NEWNET = 0x40000000

MS_NOSUID = 0x2
MS_NODEV = 0x4
MS_BIND = 0x1000
MS_REC = 0x4000
MS_SLAVE = 0x80000

MOUNT_ATTR_RDONLY = 0x1
MOUNT_ATTR_NOSUID = 0x2

_MNT_DETACH = 2
_AT_FDCWD = -100
_AT_RECURSIVE = 0x8000
#: The same number on every architecture, unlike those of older calls.
_SYS_MOUNT_SETATTR = 442
# keyctl(2), add_key(2) and their kind have numbers that differ.
_SYS_KEYCTL = {"x86_64": 250, "aarch64": 219, "riscv64": 219}
_KEYCTL_JOIN_SESSION_KEYRING = 1
_PR_SET_SECCOMP = 22
_SECCOMP_MODE_FILTER = 2
_PR_SET_PDEATHSIG = 1
_PR_SET_DUMPABLE = 4
_PR_CAPBSET_DROP = 24
_PR_SET_CHILD_SUBREAPER = 36
_PR_SET_NO_NEW_PRIVS = 38
_CAPABILITY_VERSION_3 = 0x20080522


class Refused(OSError):
    """The system does not allow a step of the sandbox; the text names the step."""


class _MountAttributes(ctypes.Structure):
    """`struct mount_attr` of mount_setattr(2)."""

    _fields_ = (
        ("attr_set", ctypes.c_uint64),
        ("attr_clr", ctypes.c_uint64),
        ("propagation", ctypes.c_uint64),
        ("userns_fd", ctypes.c_uint64),
    )


class _FilterProgram(ctypes.Structure):
    """`struct sock_fprog` of seccomp(2)."""

    _fields_ = (("length", ctypes.c_ushort), ("instructions", ctypes.c_char_p))


def _checked(result: int, step: str) -> None:
    if result == -1:
        number = ctypes.get_errno()
        raise Refused(number, f"{step}: {os.strerror(number)}")


def _libc() -> ctypes.CDLL:
    return ctypes.CDLL(None, use_errno=True)


def unshare(flags: int) -> None:
    """Leave the namespaces that `flags` name for new ones (unshare(2))."""
    _checked(_libc().unshare(flags), "new namespaces")


def mount(source: str, target: str, kind: str, flags: int, options: str = "") -> None:
    """Mount (mount(2)).

    Raises:
        Refused: it is not allowed, or a path does not exist.
    """
    words = (os.fsencode(text) if text else None for text in (source, target, kind))
    data = options.encode() or None
    _checked(_libc().mount(*words, ctypes.c_ulong(flags), data), f"mount {kind or 'of'} {target}")


def set_attributes(target: str, attributes: int, *, recursive: bool = True) -> None:
    """Add restrictions to a mount and, by default, to those below it (mount_setattr(2)).

    Raises:
        Refused: the kernel is older than 5.12, or forbids it.
    """
    restrictions = _MountAttributes(attributes, 0, 0, 0)
    result = _libc().syscall(
        _SYS_MOUNT_SETATTR,
        _AT_FDCWD,
        os.fsencode(target),
        _AT_RECURSIVE if recursive else 0,
        ctypes.byref(restrictions),
        ctypes.c_size_t(ctypes.sizeof(restrictions)),
    )
    _checked(result, f"restricting {target}")


def unmount(target: str) -> None:
    """Take a mount and everything below it out of sight (umount2(2), lazily)."""
    _checked(_libc().umount2(os.fsencode(target), _MNT_DETACH), f"unmount {target}")


def pivot_root(new: str, old: str) -> None:
    """Make `new` the root; the old one appears at `old` (pivot_root(2))."""
    libc = _libc()
    number = {"x86_64": 155, "aarch64": 41, "riscv64": 41}.get(os.uname().machine)
    if number is None:
        raise Refused(errno.ENOSYS, f"pivot_root: not known on {os.uname().machine}")
    _checked(libc.syscall(number, os.fsencode(new), os.fsencode(old)), "pivot_root")


def die_with_parent(signal_number: int) -> None:
    """Have this process sent a signal when its parent's thread ends."""
    _checked(_libc().prctl(_PR_SET_PDEATHSIG, signal_number, 0, 0, 0), "parent death signal")


def adopt_orphans() -> None:
    """Become the parent of every descendant whose own parent ends."""
    _checked(_libc().prctl(_PR_SET_CHILD_SUBREAPER, 1, 0, 0, 0), "subreaper")


def hide_from_peers() -> None:
    """Close this process's memory and descriptors to others of the same user."""
    _checked(_libc().prctl(_PR_SET_DUMPABLE, 0, 0, 0, 0), "dumpable")


def give_up_privileges() -> None:
    """Drop every capability for good, and with it the right to undo the mounts."""
    libc = _libc()
    _checked(libc.prctl(_PR_SET_NO_NEW_PRIVS, 1, 0, 0, 0), "no new privileges")
    for capability in range(64):
        if libc.prctl(_PR_CAPBSET_DROP, capability, 0, 0, 0) == -1:
            if ctypes.get_errno() == errno.EINVAL:  # beyond the last one that this kernel has
                break
            _checked(-1, "dropping capabilities")
    header = (ctypes.c_uint32 * 2)(_CAPABILITY_VERSION_3, 0)
    none = (ctypes.c_uint32 * 6)()
    _checked(libc.capset(header, none), "dropping capabilities")


def leave_session_keyring() -> None:
    """Take a new, empty session keyring in place of the caller's (keyctl(2))."""
    number = _SYS_KEYCTL.get(os.uname().machine)
    if number is not None:
        joined = _libc().syscall(number, _KEYCTL_JOIN_SESSION_KEYRING, None)
        _checked(joined, "a new session keyring")


def set_filter(program: bytes) -> None:
    """Have the kernel run a filter on every system call from now on (seccomp(2)).

    Args:
        program: instructions of classic BPF, eight bytes each.

    Raises:
        Refused: there is no program, or the kernel takes none.
    """
    if not program:
        raise Refused(errno.ENOSYS, f"filter of system calls: not known on {os.uname().machine}")
    order = _FilterProgram(len(program) // 8, program)
    done = _libc().prctl(_PR_SET_SECCOMP, _SECCOMP_MODE_FILTER, ctypes.byref(order), 0, 0)
    _checked(done, "filter of system calls")
