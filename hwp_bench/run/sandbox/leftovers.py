"""Clear what a stranger's program left in its work folder of all that is no plain file."""

from __future__ import annotations

import contextlib
import os
import stat
from pathlib import Path


def remove_odd_files(folder: Path) -> None:
    """Remove links, pipes, sockets and devices from a folder and all folders in it.

    A link that leads nowhere inside a sandbox leads to real files outside it: the toolkit would
    read a test frame for a prediction. To be called when no process of the program is left.
    """
    for root, folders, files in os.walk(folder, followlinks=False):
        for name in (*folders, *files):
            path = os.path.join(root, name)
            with contextlib.suppress(OSError):
                mode = os.lstat(path).st_mode
                if not (stat.S_ISREG(mode) or stat.S_ISDIR(mode)):
                    os.unlink(path)
