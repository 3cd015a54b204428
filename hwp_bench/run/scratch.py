"""Working folders in the system's temporary folder, which do not stay when a run is killed."""

from __future__ import annotations

import contextlib
import os
import shutil
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path

_LOCK = ".held"
# A folder that is younger may not be locked yet.
_NEW_SECONDS = 60.0


@contextlib.contextmanager
def scratch_folder(prefix: str) -> Iterator[Path]:
    """Hold a new folder, which is removed in the end; remove those that killed runs have left.

    Args:
        prefix: of its name; folders of this prefix that nobody holds are removed.
    """
    from filelock import FileLock

    remove_abandoned(prefix)
    with (
        tempfile.TemporaryDirectory(prefix=prefix, ignore_cleanup_errors=True) as name,
        FileLock(Path(name) / _LOCK),
    ):
        yield Path(name)


def remove_abandoned(prefix: str) -> int:
    """Remove folders of this user that no process holds any more; returns how many."""
    from filelock import FileLock, Timeout

    removed = 0
    for folder in Path(tempfile.gettempdir()).glob(f"{prefix}*"):
        with contextlib.suppress(OSError, Timeout):
            facts = folder.lstat()
            lock = folder / _LOCK
            young = time.time() - facts.st_mtime < _NEW_SECONDS
            if folder.is_symlink() or facts.st_uid != os.getuid() or young or not lock.is_file():
                continue
            with FileLock(lock, timeout=0):
                shutil.rmtree(folder, ignore_errors=True)
                removed += 1
    return removed
