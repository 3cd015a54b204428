"""Folders: held by one process, temporary, filled by an untrusted program, or a cache."""

from __future__ import annotations

import contextlib
import os
import shutil
import stat
import subprocess
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path

from hwp_bench.base.console import notice
from hwp_bench.base.errors import HwpError, reason_of
from hwp_bench.base.files import atomic_write

#: Name of the lock file inside an output folder.
LOCK = ".lock"


@contextlib.contextmanager
def exclusive(folder: str | os.PathLike[str], *, wait: bool = False) -> Iterator[None]:
    """Hold a folder for this process; a killed process lets go of it by itself.

    On a file system without locks nothing is held: do not start two runs there.
    """
    from filelock import FileLock, Timeout

    folder = Path(folder)
    # Hidden: it stays next to captures, among which `captures/*` would find it.
    file = folder.with_name(f".{folder.name.lstrip('.')}.lock") if wait else folder / LOCK
    try:
        file.parent.mkdir(parents=True, exist_ok=True)
        file.open("a").close()
    except OSError as error:
        raise HwpError(
            f"cannot be written ({reason_of(error)})",
            where=folder,
            remedy="Choose another folder, or change its permissions.",
        ) from error
    lock = FileLock(file)
    with contextlib.ExitStack() as held:
        try:
            held.enter_context(lock.acquire(timeout=0))
        except Timeout as error:
            if not wait:
                raise HwpError(
                    "another run is writing here",
                    where=folder,
                    remedy="Wait until it has ended, or choose another folder.",
                ) from error
            notice(f"Waiting for another process that makes {folder.name.lstrip('.')} ...")
            held.enter_context(lock.acquire())
        except (OSError, NotImplementedError):  # a file system or a system without locks
            pass
        yield


#: Seconds after which a folder without a lock file counts as left behind: its process was killed
#: before it could lock it, or belonged to a version that locked nothing.
UNLOCKED_SECONDS = 24 * 3600.0


@contextlib.contextmanager
def scratch_folder(prefix: str) -> Iterator[Path]:
    """Make a folder in the system's temporary folder, and remove it in the end.

    Folders of the same prefix that killed processes of this user left are removed first. The
    system lets go of a killed process's lock, so that no folder in use is taken for one of them.
    """
    from filelock import FileLock

    remove_left(prefix)
    while True:
        folder = Path(tempfile.mkdtemp(prefix=prefix))
        lock = FileLock(folder / LOCK)
        with contextlib.suppress(OSError, NotImplementedError):  # a file system without locks
            lock.acquire()
        # Whoever cleaned up may have come between the folder and its lock.
        if folder.is_dir():
            break
        lock.release()
    try:
        yield folder
    finally:
        lock.release()
        remove_tree(folder)


def remove_left(prefix: str) -> None:
    """Remove the folders of a prefix that belong to this user and to no running process."""
    from filelock import FileLock, Timeout

    for folder in Path(tempfile.gettempdir()).glob(f"{prefix}*"):
        with contextlib.suppress(OSError, NotImplementedError, Timeout):
            facts = folder.lstat()
            # Every file is this user's on systems that number no users.
            user = os.getuid() if hasattr(os, "getuid") else facts.st_uid
            if not stat.S_ISDIR(facts.st_mode) or facts.st_uid != user:
                continue
            file = folder / LOCK
            if file.is_symlink() or not file.is_file():
                if time.time() - facts.st_mtime > UNLOCKED_SECONDS:
                    remove_tree(folder)
                continue
            with FileLock(file, timeout=0):
                remove_tree(folder)


#: Deepest folder that a run has a reason to write, below its output.
DEEPEST = 32


# `shutil.rmtree` and `os.walk` call themselves for every level (before Python 3.12), so that a
# folder nested a thousand deep ends them; and neither gets into one whose owner has closed it.


def remove_tree(folder: str | os.PathLike[str]) -> None:
    """Remove a folder and everything in it; what is not there, or cannot be removed, is left.

    Of a link only the link is removed.
    """
    if not os.path.lexists(folder):
        return
    if os.path.islink(folder):
        with contextlib.suppress(OSError):
            os.unlink(folder)
        return
    with contextlib.suppress(OSError):
        open_up(Path(folder))
    shutil.rmtree(folder, ignore_errors=True)


def open_up(folder: Path) -> None:
    """Make everything in a folder readable for its owner, and leave only plain files and folders.

    Links, pipes, sockets and devices are removed, and so is whatever lies deeper than `DEEPEST`.
    Files lose what gives rights to whoever runs them: set-user-id, set-group-id, capabilities.
    To be called when no process that writes there is left.
    """
    waiting, remover = [(os.fspath(folder), 0)], shutil.which("rm")
    while waiting:
        place, depth = waiting.pop()
        with contextlib.suppress(OSError):
            os.chmod(place, 0o700)
        try:
            entries = list(os.scandir(place))
        except OSError:
            continue
        for entry in entries:
            with contextlib.suppress(OSError):
                mode = entry.stat(follow_symlinks=False).st_mode
                if stat.S_ISDIR(mode) and depth < DEEPEST:
                    waiting.append((entry.path, depth + 1))
                elif stat.S_ISDIR(mode) and remover:
                    # `rm` goes down by descriptors, and not by paths.
                    command = [remover, "-rf", "--", entry.path]
                    subprocess.run(command, check=False, stderr=subprocess.DEVNULL, timeout=600)
                elif not stat.S_ISREG(mode):
                    os.unlink(entry.path)
                else:
                    _take_rights(entry.path, stat.S_IMODE(mode))


def _take_rights(path: str, mode: int) -> None:
    """Make a file readable for its owner, and no program that runs with another's rights."""
    plain = mode & 0o777 if mode & stat.S_IRUSR else 0o600
    if plain != mode:
        os.chmod(path, plain)
    if mode & 0o111 and hasattr(os, "removexattr"):
        with contextlib.suppress(OSError):
            os.removexattr(path, "security.capability", follow_symlinks=False)


#: Permissions that let others than the owner write.
_OTHERS_WRITE = stat.S_IWGRP | stat.S_IWOTH


def trim(folder: Path, suffix: str, max_bytes: int) -> None:
    """Remove the files that were used longest ago until the rest fits."""
    entries = []
    with contextlib.suppress(OSError):
        for entry in os.scandir(folder):
            # Another process may remove what this one has just listed.
            with contextlib.suppress(OSError):
                if entry.name.endswith(suffix):
                    status = entry.stat(follow_symlinks=False)
                    entries.append((status.st_mtime_ns, status.st_size, entry.path))
    total = sum(size for _, size, _ in entries)
    for _, size, path in sorted(entries):
        if total <= max_bytes:
            return
        with contextlib.suppress(OSError):
            os.unlink(path)
        total -= size


def read_private(path: Path, max_bytes: int) -> bytes | None:
    """Read a file that only this user can have written."""
    try:
        if not _private(os.lstat(path.parent)):
            return None
        handle = os.open(path, os.O_RDONLY | getattr(os, "O_NOFOLLOW", 0))
    except OSError:
        return None
    with os.fdopen(handle, "rb") as stream:
        # What was opened is looked at, not the name, which may have changed hands.
        status = os.fstat(handle)
        if not (stat.S_ISREG(status.st_mode) and _private(status)) or status.st_size > max_bytes:
            return None
        with contextlib.suppress(OSError):
            os.utime(path)
        return stream.read(max_bytes)


def write_private(path: Path, data: bytes) -> bool:
    """Write a file for this user alone, in a folder that is made for this user alone."""
    try:
        path.parent.parent.mkdir(parents=True, exist_ok=True)
        path.parent.mkdir(mode=0o700, exist_ok=True)
        if not _private(os.lstat(path.parent)):
            return False
        atomic_write(path, data)
        os.chmod(path, 0o600)
    except (OSError, HwpError):
        return False
    return True


def _private(status: os.stat_result) -> bool:
    """Whether only this user can change it. Systems without users have nobody else."""
    if stat.S_ISLNK(status.st_mode):
        return False
    user = getattr(os, "geteuid", None)
    return user is None or (status.st_uid == user() and not status.st_mode & _OTHERS_WRITE)
