"""Small videos that PyAV encodes, with the marks of colour and shape that a test asks for."""

from __future__ import annotations

import contextlib
import os
from collections.abc import Iterator, Sequence
from fractions import Fraction
from pathlib import Path
from typing import Any

import numpy as np

#: Weights of red and blue by the number of the matrix in H.273.
WEIGHTS = {1: (0.2126, 0.0722), 5: (0.299, 0.114), 6: (0.299, 0.114), 9: (0.2627, 0.0593)}
#: ITU-R BT.2087: linear BT.2020 to BT.709.
TO_BT709 = np.array(
    [[1.6605, -0.5876, -0.0728], [-0.1246, 1.1329, -0.0083], [-0.0182, -0.1006, 1.1187]]
)
#: Marks of HLG in BT.2020, and its samples, as phones write them.
HLG = {"colorspace": 9, "color_primaries": 9, "color_trc": 18, "color_range": 1}
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


def from_srgb(values: np.ndarray) -> np.ndarray:
    return np.where(values <= 0.04045, values / 12.92, ((values + 0.055) / 1.055) ** 2.4)


def scene_to_hlg(light: np.ndarray) -> np.ndarray:
    a = 0.17883277
    b, c = 1 - 4 * a, 0.5 - a * np.log(4 * a)
    high = a * np.log(np.maximum(12 * light - b, 1e-9)) + c
    return np.where(light <= 1 / 12, np.sqrt(3 * light), high)


def samples_of(signal: np.ndarray, matrix: int, *, full: bool, bits: int) -> list[np.ndarray]:
    """Rounded samples (N,) of signals (N, 3)."""
    red, blue = WEIGHTS[matrix]
    y = signal @ [red, 1 - red - blue, blue]
    cb, cr = (signal[:, 2] - y) / (2 - 2 * blue), (signal[:, 0] - y) / (2 - 2 * red)
    step, most = 2 ** (bits - 8), 2**bits - 1
    if full:
        values = y * most, cb * most + 128 * step, cr * most + 128 * step
    else:
        values = (16 + 219 * y) * step, (128 + 224 * cb) * step, (128 + 224 * cr) * step
    kind = np.uint8 if bits == 8 else np.uint16
    return [np.clip(np.round(value), 0, most).astype(kind) for value in values]


def ordinary_hlg(values: np.ndarray) -> list[np.ndarray]:
    """Samples (N,) of sRGB in [0, 1], (N, 3), shown at 203 cd/m2: HLG in BT.2020, 10 bits."""
    light = from_srgb(values) @ np.linalg.inv(TO_BT709).T * 0.203
    bright = light @ [0.2627, 0.6780, 0.0593]
    scene = light * np.maximum(bright, 1e-9)[:, None] ** (1 / 1.2 - 1)
    return samples_of(scene_to_hlg(scene), 9, full=False, bits=10)


def hlg_frame(image: np.ndarray) -> list[np.ndarray]:
    """Planes, 4:2:0, of a frame (H, W, 3) uint8 sRGB of even size."""
    planes = ordinary_hlg(image.reshape(-1, 3) / 255.0)
    first, *rest = (plane.reshape(image.shape[:2]) for plane in planes)
    return [first, *(plane[::2, ::2] for plane in rest)]


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
