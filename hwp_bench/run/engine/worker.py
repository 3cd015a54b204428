"""The process that one job runs in; started by `process`.

It ends, with every process of its own, when whoever started it is gone.
"""

from __future__ import annotations

import contextlib
import os
import pickle
import shutil
import signal
import sys
import threading
import time
from collections.abc import Sequence
from pathlib import Path

from hwp_bench.base.errors import HwpError
from hwp_bench.base.files import write_json
from hwp_bench.run.engine.failures import error_record

#: How far the job is, in the folder of the process's messages.
PROGRESS = "progress.json"
#: Why it failed.
FAILURE = "failure.json"
#: Exit status of a job that was told to stop.
INTERRUPTED = 130
#: Seconds between two looks at whether the parent lives, and between two notes of progress.
LOOK_SECONDS = 0.5
#: Seconds that an orphan may take to end its own processes.
GRACE_SECONDS = 20.0


def main() -> int:
    """Read one job from standard input and do it; returns the exit status."""
    signal.signal(signal.SIGTERM, signal.default_int_handler)
    # The job comes from our own parent process through a pipe.
    work, inputs, output, messages, parent, folders = pickle.load(sys.stdin.buffer)
    threading.Thread(target=_watch, args=(parent, folders), daemon=True).start()
    try:
        work(inputs, output, _Note(messages / PROGRESS))
    except HwpError as error:
        write_json(messages / FAILURE, error_record(error))
        return 1
    except KeyboardInterrupt:
        return INTERRUPTED
    finally:
        if os.getppid() != parent:
            _remove(folders)
    return 0


class _Note:
    """Writes down how far the job is, not too often."""

    def __init__(self, path: Path) -> None:
        self._path = path
        self._next = 0.0

    def __call__(self, done: int, total: int) -> None:
        if (now := time.monotonic()) >= self._next:
            self._next = now + LOOK_SECONDS
            with contextlib.suppress(HwpError):
                write_json(self._path, [done, total])


def _watch(parent: int, folders: Sequence[Path]) -> None:
    while os.getppid() == parent:
        time.sleep(LOOK_SECONDS)
    # As by Ctrl-C, so that a method's processes are stopped and temporary files removed.
    os.kill(os.getpid(), signal.SIGINT)
    time.sleep(GRACE_SECONDS)
    _remove(folders)
    os._exit(1)


def _remove(folders: Sequence[Path]) -> None:
    for folder in folders:
        shutil.rmtree(folder, ignore_errors=True)


if __name__ == "__main__":
    sys.exit(main())
