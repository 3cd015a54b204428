"""H.264 as a phone records: a clip through the encoder and back, frame by frame in its order.

One thread and a fixed rate control: the same frames give the same stream on any machine with the
same build of x264, whatever rendered them.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterable, Iterator
from fractions import Fraction
from types import ModuleType
from typing import Any

import numpy as np

from hwp_bench.base.errors import HwpError
from hwp_bench.base.images import yuv_planes

#: Encoder in FFmpeg's naming, its preset, and the frames from one that stands alone to the next.
ENCODER, PRESET, KEYFRAME_EVERY = "libx264", "veryfast", 30
#: Frames of which the rate control may move bits from one to another.
BUFFER_FRAMES = 30


def has_encoder() -> bool:
    """Whether H.264 can be encoded here."""
    try:
        _library("")
    except HwpError:
        return False
    return True


def check_encoder(where: str) -> None:
    """Refuse a scene whose video cannot be encoded here.

    Args:
        where: name of the scene.

    Raises:
        HwpError: PyAV with x264 is not installed.
    """
    _library(where)


def through_h264(
    frames: Iterable[np.ndarray], bits_per_pixel: float, fps: float, where: str
) -> Iterator[np.ndarray]:
    """Encode a clip and decode it again.

    Args:
        frames: (H, W, 3) uint8 sRGB, all of one size, in their order; they are read as they are
            needed.
        bits_per_pixel: mean size of the stream; a phone's camera writes 0.1 to 0.3, a messenger
            0.03 to 0.1.
        fps: frames per second.
        where: name of the scene, for messages.

    Yields:
        (H, W, 3) uint8 sRGB for each frame.

    Raises:
        HwpError: there is no encoder, or it fails.
    """
    av = _library(where)
    try:
        yield from _coded(av, iter(frames), bits_per_pixel, fps)
    except av.error.FFmpegError as error:
        raise HwpError(f"the video encoder failed ({error})", where=where) from error


def _coded(
    av: ModuleType, frames: Iterator[np.ndarray], bits_per_pixel: float, fps: float
) -> Iterator[np.ndarray]:
    first = next(frames, None)
    if first is None:
        return
    height, width = first.shape[:2]
    encoder = _encoder(av, (height, width), bits_per_pixel, fps)
    decoder = av.CodecContext.create("h264", "r")

    def decoded(packets: list[Any]) -> Iterator[np.ndarray]:
        for packet in packets:
            for frame in decoder.decode(packet):
                yield _to_rgb(frame.to_ndarray(format="yuv420p"), height, width)

    for number, image in enumerate(itertools.chain([first], frames)):
        frame = av.VideoFrame.from_ndarray(yuv_planes(image), format="yuv420p")
        frame.pts = number
        yield from decoded(encoder.encode(frame))
    yield from decoded(encoder.encode(None))
    yield from decoded([None])


def _encoder(av: ModuleType, size: tuple[int, int], bits_per_pixel: float, fps: float) -> Any:
    height, width = (edge + edge % 2 for edge in size)
    rate = Fraction(fps).limit_denominator(1000)
    bits = max(int(bits_per_pixel * height * width * float(rate)), 1000)
    encoder = av.CodecContext.create(ENCODER, "w")
    most = f"vbv-maxrate={bits // 1000 + 1}:vbv-bufsize={_buffer(bits, rate) // 1000 + 1}"
    settings = {
        "width": width,
        "height": height,
        "pix_fmt": "yuv420p",
        "framerate": rate,
        "time_base": 1 / rate,
        "bit_rate": bits,
        "gop_size": KEYFRAME_EVERY,
        "max_b_frames": 0,
        "thread_count": 1,
        "options": {"preset": PRESET, "x264-params": f"{most}:threads=1:rc-lookahead=10"},
    }
    for name, value in settings.items():
        setattr(encoder, name, value)
    return encoder


def _buffer(bits: int, rate: Fraction) -> int:
    """Bits of `BUFFER_FRAMES` frames."""
    return int(bits / rate * BUFFER_FRAMES)


def _to_rgb(planes: np.ndarray, height: int, width: int) -> np.ndarray:
    import cv2

    image = cv2.cvtColor(planes, cv2.COLOR_YUV2RGB_I420)
    return np.ascontiguousarray(image[:height, :width], dtype=np.uint8)


def _library(where: str) -> ModuleType:
    """PyAV, if it has the encoder."""
    try:
        import av

        av.codec.Codec(ENCODER, "w")
    except (ImportError, ValueError) as error:
        raise HwpError(
            "its sensor stores H.264, and nothing here can encode that",
            where=where,
            field="sensor.h264",
            remedy="Install PyAV: pip install av; or leave the field out.",
        ) from error
    library: ModuleType = av
    return library
