"""Memory of clips that are written, read, checked and scored frame by frame.

Oracle: a frame and its mask at 64 px are 16 kB; what grows with the clip are its parameters, its
cameras and a line for each file, below a quarter of that.
"""

from __future__ import annotations

import tracemalloc
from collections.abc import Callable
from functools import partial
from pathlib import Path

import pytest
from small_captures import CaptureMaker

from hwp_bench.capture import Capture, open_capture
from hwp_bench.capture.check import check_capture
from hwp_bench.metrics.score import Frame, score_frames

SIZE, FRAMES = 64, (50, 250)
PIXELS = SIZE * SIZE * 4


def read_and_score(capture: Capture) -> None:
    def read(frame: int) -> Frame:
        image = capture.frame(frame)
        return Frame(image, image, capture.mask(frame))

    frames = [partial(read, frame) for frame in range(len(capture))]
    for _ in score_frames(frames, workers=1):
        pass


def peak(work: Callable[[], object]) -> int:
    """Largest memory of Python and NumPy during the work, bytes."""
    tracemalloc.start()
    try:
        work()
        return tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()


def grown(works: dict[int, Callable[[], object]]) -> float:
    """Bytes that each further frame takes."""
    works[FRAMES[0]]()  # what is loaded once is loaded now
    few, many = (peak(works[count]) for count in FRAMES)
    return (many - few) / (FRAMES[1] - FRAMES[0])


@pytest.fixture
def paths(make_capture: CaptureMaker) -> dict[int, Path]:
    made = {n: make_capture(f"long{n}", frames=n, size=SIZE) for n in FRAMES}
    return {count: capture.root for count, capture in made.items()}


def test_reading_checking_and_scoring_keep_no_frame(paths: dict[int, Path]) -> None:
    checks = {count: partial(check_capture, path) for count, path in paths.items()}
    scores = {count: partial(read_and_score, open_capture(path)) for count, path in paths.items()}
    assert grown(checks) < PIXELS / 4
    assert grown(scores) < PIXELS / 4


def test_writing_keeps_no_frame(make_capture: CaptureMaker, tmp_path: Path) -> None:
    calls = iter(range(10))

    def write(frames: int) -> None:
        make_capture(f"w{frames}", frames=frames, size=SIZE, folder=tmp_path / str(next(calls)))

    assert grown({count: partial(write, count) for count in FRAMES}) < PIXELS / 4
