"""One render at a time of the same capture, across processes."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator
from pathlib import Path

from hwp_bench.base.errors import HwpError
from hwp_bench.base.progress import notice


@contextlib.contextmanager
def alone(path: Path) -> Iterator[None]:
    """Hold a lock file; whoever comes second waits. A killed process lets go of it by itself.

    Args:
        path: the lock file; it stays behind, empty.

    Raises:
        HwpError: the place cannot be written.
    """
    try:
        import fcntl
    except ImportError:  # no file locks on this system: renders must not be doubled by hand
        yield
        return
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        stream = path.open("w")
    except OSError as error:
        raise HwpError(f"cannot be made ({error.strerror})", where=path) from error
    with stream:
        try:
            fcntl.flock(stream, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError:
            notice(f"Waiting for another process that renders {path.stem.lstrip('.')} ...")
            fcntl.flock(stream, fcntl.LOCK_EX)
        yield
