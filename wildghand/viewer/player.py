"""Plays the frames of a motion by the clock, in a thread of its own."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable


class Player:
    """Goes from frame to frame; where drawing is slower, frames are left out.

    Args:
        count: frames, which are played round and round.
        fps: frames per second at speed 1.
        show: takes the frame that is due.
    """

    def __init__(self, count: int, fps: float, show: Callable[[int], None]) -> None:
        self._count, self._fps, self._show = count, fps, show
        #: Times the speed of the clip.
        self.speed = 1.0
        self._stop = threading.Event()
        self._thread: threading.Thread | None = None

    def play(self, frame: int) -> None:
        """Begin at a frame; does nothing while it plays."""
        if self._thread is None:
            self._stop.clear()
            self._thread = threading.Thread(target=self._run, args=(frame,), daemon=True)
            self._thread.start()

    def stop(self) -> None:
        """Stop, and wait until it has."""
        thread, self._thread = self._thread, None
        if thread is not None:
            self._stop.set()
            thread.join(timeout=10.0)

    def _run(self, frame: int) -> None:
        place, before = float(frame), time.monotonic()
        while not self._stop.wait(1.0 / self._fps):
            now = time.monotonic()
            place, before = place + (now - before) * self._fps * self.speed, now
            self._show(int(place) % self._count)
