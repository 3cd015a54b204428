"""Small videos that PyAV encodes, with the marks of colour and shape that a test asks for."""

from __future__ import annotations

import contextlib
import os
from collections.abc import Iterator, Sequence
from fractions import Fraction
from pathlib import Path
from typing import Any

import numpy as np

#: Encoders that keep every sample.
LOSSLESS = {
    "libx264": {"qp": "0", "preset": "ultrafast"},
    "libx265": {"x265-params": "lossless=1:bframes=0:log-level=none", "preset": "ultrafast"},
    "ffv1": {},
}


@contextlib.contextmanager
def ordinary_priority() -> Iterator[None]:
    """Undo what SVT-AV1 does to a process of root: a real-time one starves the others."""
    try:
        yield
    finally:
        for thread in os.listdir("/proc/self/task"):
            with contextlib.suppress(OSError):
                os.sched_setscheduler(int(thread), os.SCHED_OTHER, os.sched_param(0))


def pictures(count: int = 24, size: tuple[int, int] = (64, 48)) -> list[np.ndarray]:
    """Frames (H, W, 3) that are told apart by their grey, with noise so that they take bytes."""
    rng = np.random.default_rng(0)
    width, height = size
    made = []
    for number in range(count):
        image = np.full((height, width, 3), 9 * number, dtype=np.uint8)
        image[:, width // 2 :] += rng.integers(0, 30, (height, width - width // 2, 3), np.uint8)
        made.append(image)
    return made


def write_samples(
    path: Path,
    frames: Sequence[Sequence[np.ndarray]],
    pix_fmt: str,
    codec: str,
    *,
    marks: dict[str, int] | None = None,
    options: dict[str, str] | None = None,
    aspect: Fraction | None = None,
) -> Path:
    """Write a video of given samples.

    Args:
        path: the file; its ending chooses the container.
        frames: of each its planes, (H, W) uint8 or uint16.
        pix_fmt: FFmpeg's name of their layout.
        codec: FFmpeg's name of the encoder.
        marks: `colorspace`, `color_primaries`, `color_trc`, `color_range` by H.273.
        options: of the encoder; those of `LOSSLESS` by default.
        aspect: width of a pixel by its height.
    """
    import av

    height, width = frames[0][0].shape
    with ordinary_priority(), av.open(str(path), "w") as container:
        options = dict(LOSSLESS.get(codec, {}) if options is None else options)
        stream: Any = container.add_stream(codec, rate=30, options=options)
        stream.width, stream.height, stream.pix_fmt = width, height, pix_fmt
        for name, value in (marks or {}).items():
            setattr(stream.codec_context, name, value)
        if aspect is not None:
            stream.codec_context.sample_aspect_ratio = aspect
        for number, planes in enumerate(frames):
            frame = av.VideoFrame(width, height, pix_fmt)
            frame.pts = number
            for plane, samples in zip(frame.planes, planes, strict=True):
                item = samples.dtype.itemsize
                rows = np.zeros((samples.shape[0], plane.line_size // item), samples.dtype)
                rows[:, : samples.shape[1]] = samples
                plane.update(rows.tobytes())
            for name, value in (marks or {}).items():
                setattr(frame, name, value)
            container.mux(stream.encode(frame))
        container.mux(stream.encode(None))
    return path


def silence(seconds: float) -> Any:
    """A frame of sound for PyAV, 44.1 kHz."""
    import av

    samples = np.zeros((1, round(44100 * seconds)), np.float32)
    heard = av.AudioFrame.from_ndarray(samples, format="fltp", layout="mono")
    heard.sample_rate = 44100
    return heard


def write_pictures(
    path: Path,
    images: Sequence[np.ndarray],
    codec: str = "libx264",
    *,
    pix_fmt: str = "yuv420p",
    options: dict[str, str] | None = None,
    container_options: dict[str, str] | None = None,
    aspect: Fraction | None = None,
    sound: float = 0.0,
    times: Sequence[int] | None = None,
) -> Path:
    """Write frames (H, W, 3) uint8; with `sound` there are as many seconds of silence too.

    `times`, ms: when each is shown; None: 30 a second.
    """
    import av

    height, width = images[0].shape[:2]
    with (
        ordinary_priority(),
        av.open(str(path), "w", options=container_options or {}) as container,
    ):
        stream: Any = container.add_stream(codec, rate=30, options=options or {})
        stream.width, stream.height, stream.pix_fmt = width, height, pix_fmt
        if aspect is not None:
            stream.codec_context.sample_aspect_ratio = aspect
        noise: Any = container.add_stream("aac", rate=44100) if sound else None
        if times is not None:
            stream.codec_context.time_base = Fraction(1, 1000)
        for number, image in enumerate(images):
            frame = av.VideoFrame.from_ndarray(image, format="rgb24")
            if times is not None:
                frame.pts, frame.time_base = times[number], Fraction(1, 1000)
            container.mux(stream.encode(frame))
        container.mux(stream.encode(None))
        if noise is not None:
            container.mux(noise.encode(silence(sound)))
            container.mux(noise.encode(None))
    return path
