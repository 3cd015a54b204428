"""One process at a time on one folder: whoever comes second is refused, or waits."""

from __future__ import annotations

import contextlib
import os
from collections.abc import Iterator
from pathlib import Path

from hwp_bench.base.errors import HwpError, reason_of
from hwp_bench.base.progress import notice

#: Name of the lock file inside an output folder.
LOCK = ".lock"


@contextlib.contextmanager
def exclusive(folder: str | os.PathLike[str], *, wait: bool = False) -> Iterator[None]:
    """Hold a folder for this process; a killed process lets go of it by itself.

    On a file system without locks nothing is held: do not start two runs there.

    Args:
        folder: made if it does not exist. An empty lock file stays in it.
        wait: wait for the other process instead of refusing. The lock file then lies next to the
            folder, as `NAME.lock`, because the holder usually makes the folder as a whole; the
            folder itself is not made.

    Raises:
        HwpError: another process holds it, or it cannot be written to.
    """
    from filelock import FileLock, Timeout

    folder = Path(folder)
    file = folder.with_name(f"{folder.name}.lock") if wait else folder / LOCK
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
