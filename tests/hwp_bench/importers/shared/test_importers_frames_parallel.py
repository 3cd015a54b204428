"""Frames in several threads. Oracle: the plain loop."""

from __future__ import annotations

import os
import threading

import pytest

from hwp_bench.importers.shared.frames import MOST_THREADS, each_frame


@pytest.mark.parametrize("cores", [1, 2, 64])
def test_results_come_in_order(cores: int, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(os, "cpu_count", lambda: cores)
    later = threading.Event()

    def work(frame: int) -> int:
        if frame == 0 and cores > 1:
            assert later.wait(300.0)  # the first result is ready after the second
        later.set()
        return frame * frame

    assert list(each_frame(work, range(50))) == [frame * frame for frame in range(50)]


def test_few_results_are_held_and_an_error_ends_the_work() -> None:
    begun = []

    def work(frame: int) -> int:
        begun.append(frame)
        if frame == 3:
            raise ValueError("frame 3")
        return frame

    found = each_frame(work, range(1000))
    assert next(found) == 0
    with pytest.raises(ValueError, match="frame 3"):
        list(found)
    assert len(begun) < 20 * MOST_THREADS
