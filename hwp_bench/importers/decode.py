"""Frames of a video file through OpenCV, with damage named instead of passed on."""

from __future__ import annotations

import contextlib
import os
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from hwp_bench.base.errors import BadInput, UsageError
from hwp_bench.base.images import MAX_PIXELS


@dataclass(frozen=True)
class VideoInfo:
    """What a video is.

    Attributes:
        path: the file.
        width: pixels, after the rotation that the file asks for.
        height: pixels.
        fps: frames per second; 30 where the file does not say.
        stated_frames: number of frames that the container states, 0 where it does not.
    """

    path: Path
    width: int
    height: int
    fps: float
    stated_frames: int


@dataclass(frozen=True)
class FrameRange:
    """Which frames of a video to take: start, start + stride, ... below stop.

    Attributes:
        start: first frame, counted from 0.
        stop: end, not included; None = to the end.
        stride: step.
    """

    start: int = 0
    stop: int | None = None
    stride: int = 1

    def __post_init__(self) -> None:
        if self.start < 0 or self.stride < 1 or (self.stop is not None and self.stop <= self.start):
            raise UsageError(
                f"{self.start}:{'' if self.stop is None else self.stop} with stride {self.stride} "
                "selects no frames",
                field="--frames",
                remedy="Use A:B with 0 <= A < B, and a stride of at least 1.",
            )

    def indices(self, frame_count: int) -> np.ndarray:
        """Return the selected indices of a video of `frame_count` frames, (F,) int64."""
        stop = frame_count if self.stop is None else min(self.stop, frame_count)
        return np.arange(self.start, stop, self.stride)


def parse_frame_range(text: str | None, stride: int) -> FrameRange:
    """Read `A:B`, `A:` or `:B`.

    Raises:
        UsageError: not of that form, or it selects nothing.
    """
    if text is None:
        return FrameRange(stride=stride)
    head, colon, tail = text.partition(":")
    try:
        if not colon:
            raise ValueError
        return FrameRange(int(head or 0), int(tail) if tail else None, stride)
    except ValueError as error:
        raise UsageError(
            f"{text!r} is no range", field="--frames", remedy="Use A:B, A: or :B."
        ) from error


def probe(path: str | os.PathLike[str]) -> VideoInfo:
    """Open a video and decode its first frame.

    Raises:
        BadInput: missing, empty, no video that OpenCV reads, no frame, or frames too large.
    """
    path = Path(path)
    with _opened(path) as capture:
        import cv2

        width = int(capture.get(cv2.CAP_PROP_FRAME_WIDTH))
        height = int(capture.get(cv2.CAP_PROP_FRAME_HEIGHT))
        if width * height > MAX_PIXELS:
            raise BadInput(
                f"is {width}x{height}, above the limit of {MAX_PIXELS} px per frame", where=path
            )
        fps = float(capture.get(cv2.CAP_PROP_FPS))
        stated = capture.get(cv2.CAP_PROP_FRAME_COUNT)
        found, frame = capture.read()
        if not found or frame is None:
            raise BadInput("holds no frame that can be decoded", where=path)
    return VideoInfo(
        path=path,
        width=frame.shape[1],
        height=frame.shape[0],
        fps=fps if np.isfinite(fps) and 0 < fps <= 1000 else 30.0,
        stated_frames=int(stated) if np.isfinite(stated) and 0 < stated < 2**31 else 0,
    )


def read_frames(info: VideoInfo, selection: FrameRange) -> Iterator[tuple[int, np.ndarray]]:
    """Decode the selected frames, one after the other.

    Args:
        info: the probed video.
        selection: which frames; those between are decoded and dropped, because seeking is not
            exact in every container.

    Yields:
        (index in the video, (H, W, 3) uint8 RGB).

    Raises:
        BadInput: the size changes on the way, or the video ends before `selection.stop`.
    """
    import cv2

    index = 0
    with _opened(info.path) as capture:
        while selection.stop is None or index < selection.stop:
            if not capture.grab():
                break
            if index >= selection.start and (index - selection.start) % selection.stride == 0:
                found, frame = capture.retrieve()
                if not found or frame is None or frame.shape != (info.height, info.width, 3):
                    raise BadInput(
                        f"frame {index} cannot be decoded at {info.width}x{info.height}",
                        where=info.path,
                        remedy="Re-encode the video, or take other frames with --frames.",
                    )
                yield index, cv2.cvtColor(frame, cv2.COLOR_BGR2RGB)
            index += 1
    if selection.stop is not None and index < selection.stop:
        raise BadInput(
            f"ends after {index} frames where {selection.stop} are asked for",
            where=info.path,
            remedy="Choose other frames with --frames; the file may be truncated.",
        )


@contextlib.contextmanager
def _opened(path: Path) -> Iterator[Any]:
    import cv2

    if not path.is_file():
        raise BadInput("does not exist", where=path, remedy="Give a video file.")
    if path.stat().st_size == 0:
        raise BadInput("is empty (0 bytes)", where=path)
    capture = cv2.VideoCapture(os.fspath(path))
    try:
        if not capture.isOpened():
            raise BadInput("is no video that can be read", where=path)
        yield capture
    finally:
        capture.release()
