"""One run at a time on one output: whoever comes second is told so, and changes nothing."""

from __future__ import annotations

import contextlib
import os
from collections.abc import Iterator
from pathlib import Path

from hwp_bench.base.errors import HwpError

#: Name of the lock file inside an output folder.
LOCK = ".lock"


@contextlib.contextmanager
def sole_use(folder: str | os.PathLike[str]) -> Iterator[None]:
    """Hold an output folder for this process; a killed process lets go of it by itself.

    Args:
        folder: made if it is not there. An empty lock file stays in it.

    Raises:
        HwpError: another process holds it, or it cannot be written to.
    """
    folder = Path(folder)
    try:
        folder.mkdir(parents=True, exist_ok=True)
        stream = (folder / LOCK).open("w")
    except OSError as error:
        raise HwpError(
            f"cannot be written ({error.strerror})",
            where=folder,
            remedy="Choose another folder, or change its permissions.",
        ) from error
    with stream:
        try:
            import fcntl
        except ImportError:  # no file locks on this system: runs must not be doubled by hand
            yield
            return
        try:
            fcntl.flock(stream, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError as error:
            raise HwpError(
                "another run is writing here",
                where=folder,
                remedy="Wait until it has ended, or choose another folder.",
            ) from error
        except OSError:  # a file system without locks
            pass
        yield
