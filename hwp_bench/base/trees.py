"""Folders that an untrusted program has filled: looked through and removed, whatever is in them.

`shutil.rmtree` and `os.walk` call themselves for every level (before Python 3.12), so that a folder
nested a thousand deep ends them; and neither gets into a folder whose owner has closed it.
"""

from __future__ import annotations

import contextlib
import os
import shutil
import stat
import subprocess
from pathlib import Path

#: Deepest folder that a run has a reason to write, below its output.
DEEPEST = 32


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

    Args:
        folder: of this user.
    """
    waiting = [(os.fspath(folder), 0)]
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
                elif stat.S_ISDIR(mode):
                    _remove_deep(entry.path)
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


def _remove_deep(folder: str) -> None:
    """Remove a folder of any depth; `rm` goes down by descriptors, and not by paths."""
    if remover := shutil.which("rm"):
        subprocess.run(
            [remover, "-rf", "--", folder], check=False, stderr=subprocess.DEVNULL, timeout=600
        )
