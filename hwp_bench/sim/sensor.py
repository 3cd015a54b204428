"""The sensor: noise, sharpened edges, and the JPEG or H.264 video that a device stores.

It is not a perturbation: a frame and its clean version both pass it, with the same noise. H.264
needs the whole clip, frame by frame in its order, with one thread and a fixed rate control: the
same frames give the same stream on any machine with the same build of x264.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from fractions import Fraction
from types import ModuleType
from typing import Annotated, Any

import numpy as np
from msgspec import Meta

from hwp_bench.base import images
from hwp_bench.base.colors import LUMA
from hwp_bench.base.errors import HwpError, MissingDependency
from hwp_bench.base.records import number
from hwp_bench.sim.geometry.noise import generator


@dataclass(frozen=True)
class AutoControl:
    """Exposure and white balance that follow the image with a lag, and wander."""

    #: Mean linear luminance of the image that the exposure aims at.
    level: float = number(0.2, 0.02, 0.8)
    #: Share of the way to that level that the exposure goes, in stops; 0 holds it.
    exposure: float = number(1.0, 0.0, 1.0)
    #: Share of the way to a grey mean of the image that the white balance goes; 0 holds it.
    white_balance: float = number(0.6, 0.0, 1.0)
    #: Seconds in which both go 63 % of their way.
    lag: float = number(0.5, 0.05, 5.0)
    #: Standard deviation of the slow wandering around what the image asks for, stops.
    wander: float = number(0.06, 0.0, 1.0)


@dataclass(frozen=True)
class Sensor:
    """The sensor: light becomes a stored image, in the same way for a clean version."""

    #: Standard deviation of the noise of white, in linear light in which white is 1; darker pixels
    #: have less, by the square root of their light.
    noise: Annotated[float, Meta(ge=0.0, le=0.2)]
    #: Quality of the JPEG that the device stores, 1-100; 0 stores without loss.
    jpeg_quality: int = number(0, 0, 100)
    #: Rolling shutter: s from the reading of the first row to that of the last; 0 reads all at
    #: once.
    rolling_shutter: float = number(0.0, 0.0, 0.05)
    #: Strength of the unsharp mask on the brightness; 0 leaves edges as they are.
    sharpening: float = number(0.0, 0.0, 3.0)
    #: Exposure and white balance that follow the image, or None: both are fixed.
    auto: AutoControl | None = None
    #: Bits a pixel of the H.264 video that the device stores; 0 stores frame by frame. A phone's
    #: camera writes 0.1 to 0.3, a messenger 0.03 to 0.1.
    h264: float = number(0.0, 0.0, 4.0)


#: A sensor that changes nothing.
NOISELESS = Sensor(noise=0.0)


#: Standard deviation of the blur that sharpening subtracts, px.
SHARPENING_RADIUS = 1.0


def sensor_passes(sensor: Sensor) -> tuple[str, ...]:
    """Names of the passes that every frame takes through a sensor."""
    asked = {
        "rolling": sensor.rolling_shutter,
        "auto": sensor.auto is not None,
        "sensor": sensor.noise,
        "sharpening": sensor.sharpening,
        "jpeg": sensor.jpeg_quality,
        "h264": sensor.h264,
    }
    return tuple(name for name, setting in asked.items() if setting)


def record(
    sensor: Sensor, seed: int, frame: int, colors: tuple[np.ndarray, ...]
) -> tuple[np.ndarray, ...]:
    """Add the same noise to the light that is counted, (S, S, 3) linear, of each version."""
    if not sensor.noise:
        return colors
    rng = generator(seed, "sensor", frame)
    noise = sensor.noise * rng.normal(size=colors[0].shape)
    # Counted photons scatter with the square root of their number.
    return tuple(color + noise * np.sqrt(np.clip(color, 0.02, 1.0)) for color in colors)


def store(sensor: Sensor, image: np.ndarray) -> np.ndarray:
    """The image, (S, S, 3) uint8 sRGB, as the device stores it: sharpened, and through JPEG."""
    if sensor.sharpening:
        image = sharpened(image, sensor.sharpening)
    if not sensor.jpeg_quality:
        return image
    import cv2

    quality = [cv2.IMWRITE_JPEG_QUALITY, sensor.jpeg_quality]
    _, packed = cv2.imencode(".jpg", image[..., ::-1], quality)
    stored = cv2.imdecode(packed, cv2.IMREAD_COLOR)
    assert stored is not None
    return np.ascontiguousarray(stored[..., ::-1], dtype=np.uint8)


def sharpened(image: np.ndarray, strength: float) -> np.ndarray:
    """Unsharp mask on the luma, as a phone applies it after the tone curve: (H, W, 3) uint8."""
    import cv2

    luma = image.astype(np.float32) @ np.array(LUMA, dtype=np.float32)
    fine = luma - cv2.GaussianBlur(luma, (0, 0), SHARPENING_RADIUS)
    raised = image + (strength * fine)[..., None]
    return np.clip(np.round(raised), 0, 255).astype(np.uint8)


#: Preset of the encoder, and the frames from one that stands alone to the next.
PRESET, KEYFRAME_EVERY = "veryfast", 30
#: Frames of which the rate control may move bits from one to another.
BUFFER_FRAMES = 30


def check_encoder(where: str) -> ModuleType:
    """Refuse a scene whose video cannot be encoded here; returns PyAV."""
    try:
        return images.check_encoder()
    except MissingDependency as error:
        problem = "its sensor stores H.264, and nothing here can encode that"
        remedy = "Install PyAV: pip install av; or leave the field out."
        raise HwpError(problem, where=where, field="sensor.h264", remedy=remedy) from error


def through_h264(
    frames: Iterable[np.ndarray], bits_per_pixel: float, fps: float, where: str
) -> Iterator[np.ndarray]:
    """Encode a clip of (H, W, 3) uint8 sRGB frames and decode it again."""
    av = check_encoder(where)
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

    for index, image in enumerate(itertools.chain([first], frames)):
        frame = av.VideoFrame.from_ndarray(images.yuv_planes(image), format="yuv420p")
        frame.pts = index
        yield from decoded(encoder.encode(frame))
    yield from decoded(encoder.encode(None))
    yield from decoded([None])


def _encoder(av: ModuleType, size: tuple[int, int], bits_per_pixel: float, fps: float) -> Any:
    height, width = (edge + edge % 2 for edge in size)
    rate = Fraction(fps).limit_denominator(1000)
    bits = max(int(bits_per_pixel * height * width * float(rate)), 1000)
    encoder = av.CodecContext.create(images.ENCODER, "w")
    most = (
        f"vbv-maxrate={bits // 1000 + 1}:vbv-bufsize={int(bits / rate * BUFFER_FRAMES) // 1000 + 1}"
    )
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
        "options": {"preset": PRESET, "x264-params": f"{images.REPEATABLE}:{most}:rc-lookahead=10"},
    }
    for name, value in settings.items():
        setattr(encoder, name, value)
    return encoder


def _to_rgb(planes: np.ndarray, height: int, width: int) -> np.ndarray:
    import cv2

    image = cv2.cvtColor(planes, cv2.COLOR_YUV2RGB_I420)
    return np.ascontiguousarray(image[:height, :width], dtype=np.uint8)
