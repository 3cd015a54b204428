"""Whether the disc of a run's output had room for images while a method ran.

Many programs do not notice a full disc: OpenCV's `imwrite` leaves an empty file and returns, and
the program ends well. Such a loss is the disc's fault and not the method's.
"""

from __future__ import annotations

import contextlib
import shutil
from pathlib import Path

from hwp_bench.base.files import temporary_name

#: Free bytes below which a disc counts as full: an image of a megapixel may need this much.
LOW_SPACE = 4 << 20
# Bytes that are written to find out whether a quota still allows any.
_PROBE = 64 << 10


class SpaceWatch:
    """Looks at the free space of a folder's disc again and again, and keeps the least.

    A disc that is full for less time than lies between two looks goes unnoticed.

    Args:
        folder: the output folder of a run.
    """

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self._least: int | None = None

    def look(self) -> None:
        """Look once."""
        with contextlib.suppress(OSError):
            free = shutil.disk_usage(self._folder).free
            self._least = free if self._least is None else min(self._least, free)

    def finish(self, log_problem: str | None = None) -> str | None:
        """Look a last time, and say what the run lacked.

        Args:
            log_problem: why the run's log could not be written, if it could not.

        Returns:
            A sentence without its full stop, or None where there was always room.
        """
        self.look()
        problem = log_problem or self._refusal()
        if problem is not None:
            return f"the disc of its output could not be written while it ran ({problem})"
        if self._least is not None and self._least < LOW_SPACE:
            return f"the disc of its output was full while it ran ({self._least:,} bytes left)"
        return None

    def _refusal(self) -> str | None:
        """Why nothing can be written now, where free bytes do not tell it: quotas, inodes."""
        probe = temporary_name(self._folder / "probe")
        try:
            probe.write_bytes(bytes(_PROBE))
        except OSError as error:
            return error.strerror or type(error).__name__
        finally:
            with contextlib.suppress(OSError):
                probe.unlink(missing_ok=True)
        return None
