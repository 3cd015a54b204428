"""Folders of files that can be made again: kept below a size, and private where they must be."""

from __future__ import annotations

import contextlib
import os
import stat
from pathlib import Path

from hwp_bench.base.errors import HwpError
from hwp_bench.base.files import atomic_write

#: Permissions that let others than the owner write.
_OTHERS_WRITE = stat.S_IWGRP | stat.S_IWOTH


def trim(folder: Path, suffix: str, max_bytes: int) -> None:
    """Remove the files that were used longest ago until the rest fits.

    Args:
        folder: need not exist.
        suffix: how the names of its files end; others are left alone.
        max_bytes: of all files together.
    """
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
    """Read a file that only this user can have written.

    Returns:
        Its content; None if there is no such file, it is a link or a device, it belongs to
        somebody else, others may write to it or to its folder, or it is larger than `max_bytes`.
    """
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
    """Write a file for this user alone, in a folder that is made for this user alone.

    Returns:
        Whether it was written: not if the folder belongs to somebody else, others may write to
        it, or there is no room.
    """
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
