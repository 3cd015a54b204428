"""Images in and out through OpenImageIO: 8-bit sRGB, sizes checked, damage named; videos by PyAV.

Videos are H.264 in MP4, which browsers and phones play.
OpenCV's wheels encode H.264 on no Linux and VP9 on Linux only, and its `mp4v` plays in none of
today's browsers. PyAV's wheels (36 MB) have x264 on Linux, macOS and Windows.
"""

from __future__ import annotations

import contextlib
import hashlib
import itertools
import os
import struct
from collections.abc import Iterable, Iterator, Sequence
from fractions import Fraction
from pathlib import Path
from types import ModuleType
from typing import BinaryIO

import numpy as np
import OpenImageIO as oiio

from hwp_bench.base.errors import (
    BadImage,
    HwpError,
    MissingDependency,
    ShapeMismatch,
    check_name,
    reason_of,
)
from hwp_bench.base.files import atomic_write, check_is_file, refuse_special

#: Largest image that is decoded, in pixels: a 300 byte PNG can ask for gigabytes.
MAX_PIXELS = 64 * 1024 * 1024
# Last bytes of a whole file.
_ENDS = {".png": b"IEND\xaeB`\x82"}
# Of written JPEG files.
_JPEG_QUALITY = 98
#: zlib level of written PNG files: within 10 % of the smallest at a third of the time.
PNG_LEVEL = 3
#: An image whose channels all stay within this many levels shows nothing.
BLANK_RANGE = 8
#: First bytes by format. OpenImageIO reads dozens of others, among them film and raw formats,
#: whatever a file is called; an untrusted file must not choose such a decoder.
MAGIC = {
    "PNG": b"\x89PNG\r\n\x1a\n",
    "JPEG": b"\xff\xd8\xff",
    "BMP": b"BM",
}
#: Most parts of a PNG file that are neither pixels nor its end.
_MOST_CHUNKS = 1000
#: Most bytes of a PNG file's compressed texts and profiles, which grow a thousandfold in memory.
_MOST_COMPRESSED = 128 * 1024
#: The parts that hold such.
_COMPRESSED = (b"zTXt", b"iTXt", b"iCCP")


def is_blank(pixels: np.ndarray) -> bool:
    """Whether an image (H, W, 3) uint8 is of one colour, such as black, but for a codec's noise."""
    return int(np.ptp(pixels.reshape(-1, pixels.shape[-1]), axis=0).max()) <= BLANK_RANGE


def read_rgb(path: str | os.PathLike[str], size: tuple[int, int] | None = None) -> np.ndarray:
    """Read a colour image: (H, W, 3) uint8, sRGB."""
    pixels = _read(Path(path), size)
    channels = [0, 0, 0] if pixels.shape[2] < 3 else [0, 1, 2]
    return np.ascontiguousarray(pixels[:, :, channels])


def read_rgba(path: str | os.PathLike[str], size: tuple[int, int] | None = None) -> np.ndarray:
    """Read a colour image with its alpha, not multiplied: (H, W, 4) uint8; opaque without one."""
    pixels = _read(Path(path), size)
    count = pixels.shape[2]
    colors = pixels[:, :, [0, 0, 0] if count < 3 else [0, 1, 2]]
    opaque = np.full((*pixels.shape[:2], 1), 255, dtype=np.uint8)
    return np.concatenate([colors, pixels[:, :, -1:] if count in (2, 4) else opaque], axis=2)


def read_gray(path: str | os.PathLike[str], size: tuple[int, int] | None = None) -> np.ndarray:
    """Read a one-channel image (a mask), (H, W) uint8: of a colour image the first channel."""
    return np.ascontiguousarray(_read(Path(path), size)[:, :, 0])


def _read(path: Path, size: tuple[int, int] | None) -> np.ndarray:
    check_name(path)
    _check_kind(path)
    config = oiio.ImageSpec()
    # Otherwise colours come multiplied by alpha, and a submission's alpha would act as a mask.
    config.attribute("oiio:UnassociatedAlpha", 1)
    source = oiio.ImageInput.open(os.fspath(path), config)
    if source is None:
        raise BadImage(f"is not an image that can be read ({oiio.geterror().strip()})", where=path)
    try:
        spec = source.spec()
        height, width = spec.height, spec.width
        if height * width > MAX_PIXELS:
            raise BadImage(f"is {width}x{height}, above the limit of {MAX_PIXELS} px", where=path)
        if size is not None and (height, width) != tuple(size):
            raise BadImage(
                f"is {width}x{height} pixels where {size[1]}x{size[0]} is expected", where=path
            )
        if spec.format.basetype != oiio.UINT8:
            raise BadImage(f"holds {spec.format} samples where 8-bit is expected", where=path)
        turned = spec.get_int_attribute("Orientation", 1)
        if turned != 1:
            problem = f"asks to be turned when it is shown (EXIF orientation {turned})"
            remedy = "Store its pixels upright, without that mark."
            raise BadImage(problem, where=path, remedy=remedy)
        pixels = source.read_image(format=oiio.UINT8)
        # OpenImageIO fills what a truncated file lacks with zeros and only sets an error.
        problem = source.geterror().strip()
        if pixels is None or problem:
            reason = problem.splitlines()[0] if problem else "no pixels"
            raise BadImage(f"is damaged or truncated ({reason})", where=path)
    finally:
        source.close()
    return np.asarray(pixels, dtype=np.uint8).reshape(height, width, -1)


def _check_kind(path: Path) -> None:
    """Refuse what is not a still PNG, JPEG or BMP, before any decoder sees it."""
    check_is_file(path, error=BadImage)
    if path.stat().st_size == 0:
        raise BadImage("is empty (0 bytes)", where=path)
    try:
        with path.open("rb") as stream:
            head = stream.read(8)
            kind = next((name for name, magic in MAGIC.items() if head.startswith(magic)), None)
            if kind is None:
                raise BadImage(f"is not a {' or '.join(MAGIC)} image", where=path)
            if kind == "PNG":
                _check_parts(stream, path)
    except OSError as error:
        raise BadImage(f"cannot be read ({reason_of(error)})", where=path) from error


def _check_parts(stream: BinaryIO, path: Path) -> None:
    """Look at the parts (chunks) of a PNG file by their heads, before a decoder unpacks them."""
    parts = compressed = 0
    pixels = False
    while len(head := stream.read(8)) == 8:
        length, kind = struct.unpack(">I4s", head)
        if kind == b"acTL" and not pixels:
            raise BadImage("is an animated PNG", where=path, remedy="Store each frame as a file.")
        pixels |= kind == b"IDAT"
        parts += kind not in (b"IDAT", b"IEND")
        compressed += length if kind in _COMPRESSED else 0
        if parts > _MOST_CHUNKS or compressed > _MOST_COMPRESSED:
            raise BadImage(
                f"holds more than {_MOST_CHUNKS} parts, or {_MOST_COMPRESSED} bytes of texts and "
                "profiles next to its pixels",
                where=path,
                remedy="Store the pixels without metadata.",
            )
        stream.seek(length + 4, os.SEEK_CUR)


def write_image(path: str | os.PathLike[str], pixels: np.ndarray) -> Path:
    """Write an 8-bit image, whole or not at all.

    Args:
        pixels: (H, W) or (H, W, 1 | 3 | 4) uint8.
    """
    path = Path(path)
    array = pixels[:, :, None] if pixels.ndim == 2 else pixels
    if array.dtype != np.uint8 or array.ndim != 3 or array.shape[2] not in (1, 3, 4):
        raise ShapeMismatch(
            f"cannot store an array of shape {pixels.shape} and type {pixels.dtype} as an image",
            where=path,
        )
    check_name(path)
    if path.suffix.lower() in (".jpg", ".jpeg"):
        return _write_jpeg(path, array)
    path.parent.mkdir(parents=True, exist_ok=True)
    temporary = path.with_name(f".{os.getpid()}.{path.name}")
    output = oiio.ImageOutput.create(os.fspath(temporary))
    if output is None:
        raise HwpError(f"has an ending that is not an image format ({oiio.geterror()})", where=path)
    spec = oiio.ImageSpec(array.shape[1], array.shape[0], array.shape[2], oiio.UINT8)
    spec.attribute("oiio:ColorSpace", "sRGB")
    spec.attribute("png:compressionLevel", PNG_LEVEL)
    spec.attribute("oiio:UnassociatedAlpha", 1)
    try:
        written = output.open(os.fspath(temporary), spec) and output.write_image(
            np.ascontiguousarray(array)
        )
        problem = " ".join(output.geterror().split())
        if not (output.close() and written and _is_whole(temporary)):
            raise HwpError(f"cannot be written ({problem or 'no space or permission'})", where=path)
        os.replace(temporary, path)
    except BaseException:
        temporary.unlink(missing_ok=True)
        raise
    return path


def _write_jpeg(path: Path, pixels: np.ndarray) -> Path:
    """Write a JPEG from memory: on a full disc the library that writes files ends the program."""
    import cv2

    turned = pixels[:, :, 0] if pixels.shape[2] == 1 else pixels[:, :, 2::-1]
    quality = [cv2.IMWRITE_JPEG_QUALITY, _JPEG_QUALITY]
    _, data = cv2.imencode(".jpg", np.ascontiguousarray(turned), quality)
    return atomic_write(path, data.tobytes())


def _is_whole(file: Path) -> bool:
    """Whether a written image is complete: its library does not notice a full disc."""
    try:
        with file.open("rb") as stream:
            head, size = stream.read(6), stream.seek(0, os.SEEK_END)
            if file.suffix.lower() == ".bmp":
                return size > 0 and int.from_bytes(head[2:6], "little") == size
            end = _ENDS.get(file.suffix.lower(), b"")
            stream.seek(max(0, size - len(end)))
            return size > 0 and stream.read().endswith(end)
    except OSError:
        return False


def as_uint8(image: np.ndarray) -> np.ndarray:
    """Return an image in the 8 bits that it has on disk.

    Args:
        image: any shape, sRGB; uint8 is returned as it is; float has 0 for black and 1 for
            white, and values outside are clipped, as renderings overshoot.

    Returns:
        uint8 of the same shape: 255 * image, rounded half to even.
    """
    if image.dtype == np.uint8:
        return image
    _check_float(image)
    return np.rint(np.clip(image.astype(np.float64), 0.0, 1.0) * 255.0).astype(np.uint8)


def as_float(image: np.ndarray) -> np.ndarray:
    """Return an image with 0 for black and 1 for white.

    Args:
        image: any shape, sRGB; uint8 is divided by 255; float is returned as it is.

    Returns:
        Float of the same shape (float64 where uint8 was given); values of a float image outside
        [0, 1] stay.
    """
    if image.dtype == np.uint8:
        return image / 255.0
    _check_float(image)
    return image


def _check_float(image: np.ndarray) -> None:
    if not np.issubdtype(image.dtype, np.floating):
        raise BadImage(
            f"an image is uint8 or float, not {image.dtype}",
            field="image",
            remedy="A float image has values from 0 to 1.",
        )
    if not np.isfinite(image).all():
        raise BadImage("the image holds NaN or infinite values", field="image")


def pixel_digest(pixels: np.ndarray) -> str:
    """Return the SHA-256 (hex) of decoded pixels: shape, type and samples, not the file's bytes.

    Two PNG files of different compression level agree.
    """
    head = f"{pixels.shape}{pixels.dtype.str}".encode()
    return hashlib.sha256(head + np.ascontiguousarray(pixels).tobytes()).hexdigest()


def sample(
    image: np.ndarray, places: np.ndarray, how: int | None = None, border: int | None = None
) -> np.ndarray:
    """Read an image (H, W) or (H, W, C) at (P, 2) px, pixel centres at +0.5; C at most 4.

    `how` and `border` are OpenCV's; by default it is bilinear, and zero outside of the image.
    """
    import cv2

    padded = np.zeros((-(-max(len(places), 1) // _ROW) * _ROW, 2), np.float32)
    padded[: len(places)] = places - 0.5
    x, y = (np.ascontiguousarray(part.reshape(-1, _ROW)) for part in padded.T)
    how = cv2.INTER_LINEAR if how is None else how
    border = cv2.BORDER_CONSTANT if border is None else border
    found = cv2.remap(image, x, y, how, borderMode=border)
    return np.asarray(found.reshape(-1, *image.shape[2:])[: len(places)])


# OpenCV takes at most 32,767 places in a row.
_ROW = 1024

#: Encoder, in FFmpeg's naming.
ENCODER = "libx264"
#: Constant quality of x264: 0 is lossless, 18 hardly differs from the frames.
QUALITY = 18
#: Parameters of x264 for the same bits in every call and on every processor: the faster kernels of
#: its macroblock tree round by instruction set, and read memory that nothing wrote.
REPEATABLE = "cpu-independent=1:threads=1"
# ITU-R BT.601 with the primaries and the transfer of sRGB's relative BT.709: what players assume
# of small videos, and what those that know the marks read from them.
_MATRIX, _PRIMARIES, _TRANSFER, _LIMITED = 6, 1, 1, 1


def check_encoder() -> ModuleType:
    """Refuse to begin minutes of work whose video could not be written; returns PyAV."""
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


def write_movie(
    path: str | os.PathLike[str],
    frames: Iterable[np.ndarray],
    fps: float,
    times: Sequence[float] | None = None,
) -> Path:
    """Write a video, whole or not at all.

    H.264, 4:2:0, its index first, so that a browser plays it while it loads.

    Args:
        frames: (H, W, 3) uint8 sRGB, all of one size, read as they are needed. 4:2:0 has even
            sizes: an odd row or column at the end is doubled.
        fps: frames per second.
        times: when each frame is shown, s, rising from 0, where the steps between them differ.
    """
    path = Path(path)
    refuse_special(path)
    av = check_encoder()
    partial = path.with_name(f".{os.getpid()}.{path.stem}.mp4")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        _encode(av, partial, iter(frames), fps, times, path)
        os.replace(partial, path)
    except (OSError, av.error.FFmpegError) as error:
        raise HwpError(f"cannot be written as a video ({error})", where=path) from error
    finally:
        with contextlib.suppress(OSError):
            partial.unlink()
    return path


def _encode(
    av: ModuleType,
    partial: Path,
    frames: Iterator[np.ndarray],
    fps: float,
    times: Sequence[float] | None,
    path: Path,
) -> None:
    first = next(frames, None)
    if first is None:
        raise ShapeMismatch("a video needs a frame", where=path)
    with av.open(str(partial), "w", format="mp4", options={"movflags": "faststart"}) as container:
        height, width = (edge + edge % 2 for edge in first.shape[:2])
        rate = Fraction(fps).limit_denominator(1000)
        clock = 1 / rate if times is None else Fraction(1, 90_000)
        options = {
            "crf": str(QUALITY),
            "preset": "medium",
            "profile": "high",
            "x264-params": REPEATABLE,
        }
        stream = container.add_stream(ENCODER, rate=rate, options=options)
        settings = {
            "width": width,
            "height": height,
            "pix_fmt": "yuv420p",
            "time_base": clock,
            "colorspace": _MATRIX,
            "color_primaries": _PRIMARIES,
            "color_trc": _TRANSFER,
            "color_range": _LIMITED,
            "thread_count": 1,
        }
        for name, value in settings.items():
            setattr(stream.codec_context, name, value)
        for number, image in enumerate(itertools.chain([first], frames)):
            if image.shape != first.shape or image.ndim != 3 or image.dtype != np.uint8:
                raise ShapeMismatch(
                    f"frame {number} has shape {image.shape} and type {image.dtype}", where=path
                )
            frame = av.VideoFrame.from_ndarray(yuv_planes(image), format="yuv420p")
            frame.pts = number if times is None else round(times[number] / clock)
            container.mux(stream.encode(frame))
        container.mux(stream.encode(None))


def yuv_planes(image: np.ndarray) -> np.ndarray:
    """Return the planes Y, U, V of 4:2:0 (ITU-R BT.601), as OpenCV and FFmpeg lay them out.

    Of an image (H, W, 3), whose odd row or column at the end is doubled: (3 / 2 H, W) uint8.
    """
    import cv2

    rows, columns = image.shape[0] % 2, image.shape[1] % 2
    even = np.pad(image, ((0, rows), (0, columns), (0, 0)), mode="edge")
    return np.asarray(cv2.cvtColor(even, cv2.COLOR_RGB2YUV_I420))
