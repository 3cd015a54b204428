"""The Linux calls behind a sandbox, and those that a program inside it may not make (seccomp).

Namespaces hide files, processes and the network. What they do not cover is refused by number and
argument: keys, memory that belongs to no process, set-user-id files, namespaces and mounts of its
own, sockets of other worlds, and ways around this very list. Only the standard library is
imported, because every run of a method passes through here.
"""

from __future__ import annotations

import ctypes
import errno
import os
import struct
from collections.abc import Iterable
from typing import NamedTuple

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
PR_SET_DUMPABLE = 4
MOUNT_ATTR_RDONLY = 0x1
MOUNT_ATTR_NOSUID = 0x2
_MNT_DETACH = 2
_AT_FDCWD = -100
_AT_RECURSIVE = 0x8000
_KEYCTL_JOIN_SESSION_KEYRING = 1
_PR_SET_SECCOMP = 22
_SECCOMP_MODE_FILTER = 2
_PR_SET_PDEATHSIG = 1
_PR_CAPBSET_DROP = 24
_PR_SET_CHILD_SUBREAPER = 36
_PR_SET_NO_NEW_PRIVS = 38
_CAPABILITY_VERSION_3 = 0x20080522
# Numbers of <asm/unistd.h>: x86_64, the table that newer architectures share, and calls whose
# numbers are the same everywhere.
# fmt: off
_X86 = {
    "open": 2, "shmget": 29, "socket": 41, "socketpair": 53, "clone": 56, "msgget": 68,
    "creat": 85, "chmod": 90, "fchmod": 91, "syslog": 103, "mknod": 133,
    "sched_setscheduler": 144, "pivot_root": 155, "prctl": 157, "mount": 165, "umount2": 166,
    "add_key": 248, "request_key": 249, "keyctl": 250, "openat": 257, "mknodat": 259,
    "fchmodat": 268, "unshare": 272, "perf_event_open": 298, "open_by_handle_at": 304,
    "setns": 308, "sched_setattr": 314, "memfd_create": 319, "bpf": 321, "userfaultfd": 323,
}
_SHARED = {
    "mknodat": 33, "umount2": 39, "mount": 40, "pivot_root": 41, "fchmod": 52, "fchmodat": 53,
    "openat": 56, "unshare": 97, "syslog": 116, "sched_setscheduler": 119, "prctl": 167,
    "msgget": 186, "shmget": 194, "socket": 198, "socketpair": 199, "add_key": 217,
    "request_key": 218, "keyctl": 219, "clone": 220, "perf_event_open": 241,
    "open_by_handle_at": 265, "setns": 268, "sched_setattr": 274, "memfd_create": 279,
    "bpf": 280, "userfaultfd": 282,
}
_NEWER = {
    "io_uring_setup": 425, "io_uring_enter": 426, "io_uring_register": 427, "open_tree": 428,
    "move_mount": 429, "fsopen": 430, "fsconfig": 431, "fsmount": 432, "fspick": 433,
    "clone3": 435, "openat2": 437, "mount_setattr": 442, "memfd_secret": 447, "fchmodat2": 452,
    "open_tree_attr": 467,
}
# fmt: on
# <linux/audit.h>, and numbers above which x86_64 has a second table (x32).
_ARCHITECTURES = {
    "x86_64": (0xC000003E, _X86),
    "aarch64": (0xC00000B7, _SHARED),
    "riscv64": (0xC00000F3, _SHARED),
}
_X32 = 0x40000000
#: Refused whole, as on a kernel that is older, so that programs take another way: keys of the
#: caller, because namespaces do not cover the session's; memory that stays when no process holds
#: it; what takes a structure, which a filter cannot look into; rarely used parts of the kernel.
_NOT_THERE = (
    *("add_key", "request_key", "keyctl"),
    *("shmget", "msgget", "memfd_secret"),
    *("clone3", "openat2", "io_uring_setup", "io_uring_enter", "io_uring_register"),
    *("userfaultfd", "bpf", "perf_event_open"),
)
#: Refused whole: what would change the sandbox, or take the processor from everything else.
_FORBIDDEN = (
    *("mount", "umount2", "pivot_root", "open_tree", "open_tree_attr", "move_mount"),
    *("fsopen", "fsconfig", "fsmount", "fspick", "mount_setattr"),
    *("setns", "open_by_handle_at", "syslog"),
    *("sched_setscheduler", "sched_setattr"),
)
_SET_ID = 0o6000
#: `O_CREAT`, `O_TMPFILE`.
_CREATES = 0x40 | 0x400000
#: AF_UNIX, AF_INET, AF_INET6, AF_NETLINK. Others (vsock leads to the host of a virtual machine)
#: know no network namespaces, or are rarely used parts of the kernel.
_FAMILIES = (1, 2, 10, 16)
# Instructions of classic BPF, <linux/bpf_common.h>.
_LOAD, _EQUAL, _AT_LEAST, _ANY_BIT, _RETURN = 0x20, 0x15, 0x35, 0x45, 0x06
_ALLOW, _ERROR = 0x7FFF0000, 0x00050000
_NUMBER_AT, _ARCHITECTURE_AT, _ARGUMENTS_AT = 0, 4, 16
# Operation, instructions to skip where it holds and where not, and its number.
_Instruction = tuple[int, int, int, int]


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


def _system_call(step: str, name: str, *arguments: object) -> None:
    """Make a call that the C library has no function for."""
    _, table = _ARCHITECTURES.get(os.uname().machine, (0, _NEWER))
    number = {**table, **_NEWER}.get(name)
    if number is None:
        raise Refused(errno.ENOSYS, f"{step}: not known on {os.uname().machine}")
    _checked(_libc().syscall(number, *arguments), step)


def _prctl(option: int, value: int, step: str) -> None:
    _checked(_libc().prctl(option, value, 0, 0, 0), step)


def unshare(flags: int) -> None:
    """Leave the namespaces that `flags` name for new ones (unshare(2))."""
    _checked(_libc().unshare(flags), "new namespaces")


def mount(source: str, target: str, kind: str, flags: int, options: str = "") -> None:
    """Mount (mount(2))."""
    words = (os.fsencode(text) if text else None for text in (source, target, kind))
    data = options.encode() or None
    _checked(_libc().mount(*words, ctypes.c_ulong(flags), data), f"mount {kind or 'of'} {target}")


def set_attributes(target: str, attributes: int, *, recursive: bool = True) -> None:
    """Add restrictions to a mount and, by default, to those below it (mount_setattr(2))."""
    restrictions = _MountAttributes(attributes, 0, 0, 0)
    flags = _AT_RECURSIVE if recursive else 0
    size = ctypes.c_size_t(ctypes.sizeof(restrictions))
    path, order = os.fsencode(target), ctypes.byref(restrictions)
    _system_call(f"restricting {target}", "mount_setattr", _AT_FDCWD, path, flags, order, size)


def unmount(target: str) -> None:
    """Take a mount and everything below it out of sight (umount2(2), lazily)."""
    _checked(_libc().umount2(os.fsencode(target), _MNT_DETACH), f"unmount {target}")


def pivot_root(new: str, old: str) -> None:
    """Make `new` the root; the old one appears at `old` (pivot_root(2))."""
    _system_call("pivot_root", "pivot_root", os.fsencode(new), os.fsencode(old))


def die_with_parent(signal_number: int) -> None:
    """Have this process sent a signal when its parent's thread ends."""
    _prctl(_PR_SET_PDEATHSIG, signal_number, "parent death signal")


def adopt_orphans() -> None:
    """Become the parent of every descendant whose own parent ends."""
    _prctl(_PR_SET_CHILD_SUBREAPER, 1, "subreaper")


def hide_from_peers() -> None:
    """Close this process's memory and descriptors to others of the same user."""
    _prctl(PR_SET_DUMPABLE, 0, "dumpable")


def give_up_privileges() -> None:
    """Drop every capability for good, and with it the right to undo the mounts."""
    libc = _libc()
    _prctl(_PR_SET_NO_NEW_PRIVS, 1, "no new privileges")
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
    _system_call("a new session keyring", "keyctl", _KEYCTL_JOIN_SESSION_KEYRING, None)


# --- the filter of system calls


class _Test(NamedTuple):
    """A condition on one argument of a call, on its lower 32 bits."""

    argument: int
    #: `_EQUAL` or `_ANY_BIT`, and what the argument is compared with.
    operation: int
    value: int


def refuse_calls(*, memory_files: bool) -> None:
    """Have the kernel refuse system calls to this process and all that it starts, for good.

    It must not be able to gain privileges any more.
    """
    program = program_of(os.uname().machine, memory_files=memory_files)
    if not program:
        raise Refused(errno.ENOSYS, f"filter of system calls: not known on {os.uname().machine}")
    order = _FilterProgram(len(program) // 8, program)
    done = _libc().prctl(_PR_SET_SECCOMP, _SECCOMP_MODE_FILTER, ctypes.byref(order), 0, 0)
    _checked(done, "filter of system calls")


def program_of(machine: str, *, memory_files: bool) -> bytes:
    """Return the filter as instructions of classic BPF, eight bytes each; empty if not known."""
    if machine not in _ARCHITECTURES:
        return b""
    architecture, table = _ARCHITECTURES[machine]
    numbers = {**table, **_NEWER}
    code = [
        (_LOAD, 0, 0, _ARCHITECTURE_AT),
        (_EQUAL, 1, 0, architecture),
        _answer(errno.ENOSYS),
        (_LOAD, 0, 0, _NUMBER_AT),
    ]
    if table is _X86:
        code += [(_AT_LEAST, 0, 1, _X32), _answer(errno.ENOSYS)]
    absent = _NOT_THERE if memory_files else (*_NOT_THERE, "memfd_create")
    for names, number in ((absent, errno.ENOSYS), (_FORBIDDEN, errno.EPERM)):
        for name in names:
            code += [(_EQUAL, 0, 1, numbers[name]), _answer(number)]
    for name, tests, number in _conditions():
        if name in numbers:
            code += _conditional(numbers[name], tests, number)
    for name in ("socket", "socketpair"):
        code += _socket(numbers[name])
    code.append((_RETURN, 0, 0, _ALLOW))
    return b"".join(struct.pack("HBBI", *instruction) for instruction in code)


def _conditions() -> Iterable[tuple[str, tuple[_Test, ...], int]]:
    """Calls that are answered with an error number where all tests of their arguments hold."""
    for name in ("clone", "unshare"):
        yield name, (_Test(0, _ANY_BIT, CLONE_NEWUSER),), errno.EPERM
    # Copies of whole trees set modes that their sources have: answered as done, and not done.
    for name, place in (("chmod", 1), ("fchmod", 1), ("fchmodat", 2), ("fchmodat2", 2)):
        yield name, (_Test(place, _ANY_BIT, _SET_ID),), 0
    for name, place in (("creat", 1), ("mknod", 1), ("mknodat", 2)):
        yield name, (_Test(place, _ANY_BIT, _SET_ID),), errno.EPERM
    for name, place in (("open", 1), ("openat", 2)):
        tests = _Test(place, _ANY_BIT, _CREATES), _Test(place + 1, _ANY_BIT, _SET_ID)
        yield name, tests, errno.EPERM
    # A process that is not dumpable hides what it holds from whoever measures its memory.
    yield "prctl", (_Test(0, _EQUAL, PR_SET_DUMPABLE),), errno.EPERM


def _conditional(number: int, tests: tuple[_Test, ...], error: int) -> list[_Instruction]:
    code: list[_Instruction] = []
    left = 2 * len(tests) + 1
    code.append((_EQUAL, 0, left + 1, number))
    for test in tests:
        left -= 2
        code.append((_LOAD, 0, 0, _ARGUMENTS_AT + 8 * test.argument))
        code.append((test.operation, 0, left, test.value))
    return [*code, _answer(error), (_RETURN, 0, 0, _ALLOW)]


def _socket(number: int) -> list[_Instruction]:
    count = len(_FAMILIES)
    code = [(_EQUAL, 0, count + 3, number), (_LOAD, 0, 0, _ARGUMENTS_AT)]
    code += [(_EQUAL, count - place, 0, family) for place, family in enumerate(_FAMILIES)]
    return [*code, _answer(errno.EAFNOSUPPORT), (_RETURN, 0, 0, _ALLOW)]


def _answer(number: int) -> _Instruction:
    return (_RETURN, 0, 0, _ERROR | number)
