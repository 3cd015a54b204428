"""Temporary folders that a killed process does not leave for ever."""

from __future__ import annotations

import contextlib
import os
import shutil
import stat
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path

from hwp_bench.base.locks import LOCK

#: Seconds after which a folder without a lock file counts as left behind: its process was killed
#: before it could lock it, or belonged to a version that locked nothing.
UNLOCKED_SECONDS = 24 * 3600.0


@contextlib.contextmanager
def scratch_folder(prefix: str) -> Iterator[Path]:
    """Make a folder in the system's temporary folder, and remove it in the end.

    Those of the same prefix that killed processes of this user have left are removed first. The
    system lets go of a killed process's lock, so that no folder in use is taken for one of them.

    Args:
        prefix: how its name begins; ends with a hyphen.
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
        shutil.rmtree(folder, ignore_errors=True)


def remove_left(prefix: str) -> None:
    """Remove the folders of a prefix that belong to this user and to no running process."""
    from filelock import FileLock, Timeout

    for folder in Path(tempfile.gettempdir()).glob(f"{prefix}*"):
        with contextlib.suppress(OSError, NotImplementedError, Timeout):
            facts = folder.lstat()
            if not stat.S_ISDIR(facts.st_mode) or facts.st_uid != _user(facts):
                continue
            file = folder / LOCK
            if file.is_symlink() or not file.is_file():
                if time.time() - facts.st_mtime > UNLOCKED_SECONDS:
                    shutil.rmtree(folder, ignore_errors=True)
                continue
            with FileLock(file, timeout=0):
                shutil.rmtree(folder, ignore_errors=True)


def _user(facts: os.stat_result) -> int:
    """This user's number; every file is this user's on systems that have no numbers."""
    return os.getuid() if hasattr(os, "getuid") else facts.st_uid
