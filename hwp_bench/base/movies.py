"""Videos that browsers and phones play: H.264 in MP4, by PyAV.

OpenCV's wheels encode H.264 on no Linux and VP9 on Linux only, and its `mp4v` plays in none of
today's browsers. PyAV's wheels (36 MB) have x264 on Linux, macOS and Windows.
"""

from __future__ import annotations

import contextlib
import itertools
import os
from collections.abc import Iterable
from fractions import Fraction
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np

from hwp_bench.base.errors import HwpError, MissingDependency, ShapeMismatch

#: Encoder, in FFmpeg's naming.
ENCODER = "libx264"
#: Constant quality of x264: 0 is lossless, 18 hardly differs from the frames.
QUALITY = 18
# ITU-R BT.601 with the primaries and the transfer of sRGB's relative BT.709: what players assume
# of small videos, and what those that know the marks read from them.
_MATRIX, _PRIMARIES, _TRANSFER, _LIMITED = 6, 1, 1, 1


def check_encoder() -> None:
    """Refuse to begin minutes of work whose video could not be written.

    Raises:
        MissingDependency: PyAV is not installed, or without x264.
    """
    _library()


def write_movie(path: str | os.PathLike[str], frames: Iterable[np.ndarray], fps: float) -> Path:
    """Write a video, whole or not at all.

    H.264, 4:2:0, its index first, so that a browser plays it while it loads.

    Args:
        path: the file, `.mp4`; replaced if it is there.
        frames: (H, W, 3) uint8 sRGB, all of one size, read as they are needed. 4:2:0 has even
            sizes: an odd row or column at the end is doubled.
        fps: frames per second.

    Raises:
        MissingDependency: PyAV is not installed, or without x264.
        ShapeMismatch: no frame, or one of another size or type.
        HwpError: the file cannot be written.
    """
    path = Path(path)
    av = _library()
    partial = path.with_name(f".{os.getpid()}.{path.stem}.mp4")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        _encode(av, partial, iter(frames), fps, path)
        os.replace(partial, path)
    except (OSError, av.error.FFmpegError) as error:
        raise HwpError(f"cannot be written as a video ({error})", where=path) from error
    finally:
        with contextlib.suppress(OSError):
            partial.unlink()
    return path


def _encode(
    av: ModuleType, partial: Path, frames: Iterable[np.ndarray], fps: float, path: Path
) -> None:
    frames = iter(frames)
    first = next(frames, None)
    if first is None:
        raise ShapeMismatch("a video needs a frame", where=path)
    with av.open(str(partial), "w", format="mp4", options={"movflags": "faststart"}) as container:
        stream = _stream(container, first, fps)
        for number, image in enumerate(itertools.chain([first], frames)):
            if image.shape != first.shape or image.ndim != 3 or image.dtype != np.uint8:
                raise ShapeMismatch(
                    f"frame {number} has shape {image.shape} and type {image.dtype}", where=path
                )
            frame = av.VideoFrame.from_ndarray(yuv_planes(image), format="yuv420p")
            frame.pts = number
            container.mux(stream.encode(frame))
        container.mux(stream.encode(None))


def _stream(container: Any, first: np.ndarray, fps: float) -> Any:
    height, width = (edge + edge % 2 for edge in first.shape[:2])
    rate = Fraction(fps).limit_denominator(1000)
    options = {"crf": str(QUALITY), "preset": "medium", "profile": "high"}
    stream = container.add_stream(ENCODER, rate=rate, options=options)
    settings = {
        "width": width,
        "height": height,
        "pix_fmt": "yuv420p",
        "time_base": 1 / rate,
        "colorspace": _MATRIX,
        "color_primaries": _PRIMARIES,
        "color_trc": _TRANSFER,
        "color_range": _LIMITED,
        "thread_count": 1,
    }
    for name, value in settings.items():
        setattr(stream.codec_context, name, value)
    return stream


def yuv_planes(image: np.ndarray) -> np.ndarray:
    """Return the planes Y, U, V of 4:2:0 (ITU-R BT.601), as OpenCV and FFmpeg lay them out.

    Args:
        image: (H, W, 3) uint8 sRGB; an odd row or column at the end is doubled.

    Returns:
        (3 / 2 H, W) uint8.
    """
    import cv2

    rows, columns = image.shape[0] % 2, image.shape[1] % 2
    even = np.pad(image, ((0, rows), (0, columns), (0, 0)), mode="edge")
    return np.asarray(cv2.cvtColor(even, cv2.COLOR_RGB2YUV_I420))


def _library() -> ModuleType:
    try:
        import av

        av.codec.Codec(ENCODER, "w")
    except (ImportError, ValueError) as error:
        raise MissingDependency(
            "nothing here can encode H.264, which videos are written in",
            remedy="Install PyAV: pip install av",
        ) from error
    library: ModuleType = av
    return library
