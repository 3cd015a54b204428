"""Work on the frames of a clip in several threads, with the results in order."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from typing import TypeVar

Frame = TypeVar("Frame")
Result = TypeVar("Result")

#: Most threads; each frame's work is mostly OpenCV and compiled code, which let others run.
MOST_THREADS = 4
#: Frames that are worked on ahead of the one that is asked for, for each thread.
_AHEAD = 4


def each_frame(work: Callable[[Frame], Result], frames: Iterable[Frame]) -> Iterator[Result]:
    """Call a function for each frame in several threads.

    Args:
        work: gets one of the frames; called from several threads.
        frames: numbers of frames, or whatever else `work` takes; read as they are needed.

    Yields:
        The results in the order of `frames`, so that they do not depend on the number of threads;
        only a few are held at a time.
    """
    threads = min(MOST_THREADS, os.cpu_count() or 1)
    running: list[Future[Result]] = []
    with ThreadPoolExecutor(threads) as pool:
        try:
            for frame in frames:
                running.append(pool.submit(work, frame))
                if len(running) > threads * _AHEAD:
                    yield running.pop(0).result()
            while running:
                yield running.pop(0).result()
        finally:
            for future in running:
                future.cancel()
