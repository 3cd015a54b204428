"""A small simulated capture for benchmarks, rendered once into the cache."""

from __future__ import annotations

import dataclasses
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from hwp_bench.capture import Capture, open_capture
from hwp_bench.capture.splits import contiguous_split
from hwp_bench.methods.contract import RunSettings, TrainingCapture
from hwp_bench.methods.request import open_request, write_request
from hwp_bench.sim.produce.capture import ensure_suite, suite

#: Frames of the small capture; a benchmark repeats them.
FRAMES = 24


def small_capture(path: str | Path | None = None, frames: int = FRAMES) -> Capture:
    """Open a capture; without a path the first of `mini` (176 px), rendered if need be.

    Args:
        path: the capture.
        frames: of the one that is rendered; `mini` has 60.
    """
    if path is None:
        (path,) = ensure_suite([dataclasses.replace(suite("mini")[0], frame_count=frames)])
    return open_capture(path)


@contextmanager
def opened_request(capture: Capture, settings: dict[str, Any] | None = None) -> Iterator[Any]:
    """What a method may see of a capture (`TrainingCapture`), in a folder of its own."""
    split = contiguous_split(capture.info.id, len(capture))
    with tempfile.TemporaryDirectory() as folder:
        request = Path(folder) / "request"
        write_request(request, capture, split, RunSettings(settings or {}))
        training: TrainingCapture = open_request(request)
        yield training
