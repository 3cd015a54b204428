"""The frames of a video: decoding them, and cutting the hand's window out of each."""

from __future__ import annotations

import contextlib
import os
import re
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from hwp_bench.base.errors import BadInput, UsageError
from hwp_bench.base.images import MAX_PIXELS, read_gray
from hwp_bench.base.text import bounded, check_name
from hwp_bench.importers.shared.windows import CropWindows, cut, resample
from hwp_bench.importers.video.contour import FIELD_SIZE
from hwp_bench.importers.video.video_settings import FrameRange

#: Containers that are read, each with how its files begin.
CONTAINERS = {
    "MP4 or MOV": rb".{4}(ftyp|moov|mdat|wide|free|skip|pnot)",
    "Matroska or WebM": rb"\x1aE\xdf\xa3",
    "AVI": rb"RIFF.{4}AVI ",
    "MPEG transport stream": rb"(?:.{4})?G.{187}(?:.{4})?G",
    "MPEG": rb"\0\0\x01[\xba\xb3]",
    "Flash video": rb"FLV\x01",
    "Ogg": rb"OggS\0",
    "ASF or WMV": rb"\x30\x26\xb2\x75\x8e\x66\xcf\x11",
}
_HEAD = 512


@dataclass(frozen=True)
class VideoInfo:
    """Path, size and rate of a video.

    Attributes:
        path: the file.
        width: pixels, after the rotation that the file asks for.
        height: pixels.
        fps: frames per second; 30 where the file does not state it.
        stated_frames: number of frames that the container states, 0 where it states none.
    """

    path: Path
    width: int
    height: int
    fps: float
    stated_frames: int


def probe(path: str | os.PathLike[str]) -> VideoInfo:
    """Open a video and decode its first frame.

    Raises:
        BadInput: the file is missing or empty, OpenCV cannot read it, or its frames are too large.
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
            raise BadInput("contains no frame that can be decoded", where=path)
    return VideoInfo(
        path=path,
        width=frame.shape[1],
        height=frame.shape[0],
        fps=fps if np.isfinite(fps) and 0 < fps <= 1000 else 30.0,
        stated_frames=int(stated) if np.isfinite(stated) and 0 < stated < 2**31 else 0,
    )


@dataclass(frozen=True, eq=False)
class ClipImages:
    """The frames of a clip at two resolutions.

    Attributes:
        frames: (F, size, size, 3) uint8 RGB, as the capture stores them.
        working: (F, S, S, 3) uint8 RGB, for cutting masks: the video's own resolution, at
            most twice the stored one.
    """

    frames: np.ndarray
    working: np.ndarray


def working_size(windows: CropWindows) -> int:
    """Edge of the working images, px."""
    return min(windows.side, 2 * windows.size)


def check_memory(windows: CropWindows) -> None:
    """Refuse a clip that would not fit into memory, before minutes of work.

    Raises:
        UsageError: the images would take more than the free memory.
    """
    import psutil

    edge = working_size(windows)
    # Colours at both resolutions, the mask, the distance field, and the posed vertices.
    each = 3 * edge**2 + 4 * windows.size**2 + 2 * FIELD_SIZE**2 + 200_000
    needed, free = len(windows.corners) * each, psutil.virtual_memory().available
    if needed > free:
        raise UsageError(
            f"{len(windows.corners)} frames need about {needed / 1e9:.1f} GB of memory, "
            f"{free / 1e9:.1f} GB are free",
            field="--frames",
            remedy="Take fewer frames with --frames or --stride, or a smaller --size.",
        )


def read_images(
    info: VideoInfo,
    selection: FrameRange,
    windows: CropWindows,
    update: Callable[[int], None] | None = None,
) -> ClipImages:
    """Decode the video once and keep the window of every selected frame.

    Raises:
        BadInput: the video ends early, goes on longer than the landmarks, or is damaged.
    """
    count, edge = len(windows.corners), working_size(windows)
    frames = np.zeros((count, windows.size, windows.size, 3), dtype=np.uint8)
    working = np.zeros((count, edge, edge, 3), dtype=np.uint8)
    done = 0
    for _, image in read_frames(info, selection):
        if done < count:
            square = cut(image, windows.corners[done], windows.side)
            frames[done] = resample(square, windows.size)
            working[done] = resample(square, edge)
        done += 1
        if update is not None:
            update(min(done, count))
    if done != count:
        raise BadInput(
            f"has {done} frames, the landmarks have {count}",
            where=info.path,
            remedy="The video may be truncated, or the landmarks belong to another one.",
        )
    return ClipImages(frames, working)


def read_masks(
    folder: str | os.PathLike[str],
    info: VideoInfo,
    indices: np.ndarray,
    windows: CropWindows,
) -> np.ndarray:
    """Read the user's masks and cut the windows out of them.

    Args:
        folder: images of the video's size whose names end in the frame number (`000012.png`,
            `frame_12.png`); above 127 is hand.
        info: the video.
        indices: (F,) frame numbers to read.
        windows: of those frames.

    Returns:
        (F, S, S) uint8 at the working resolution, 255 = hand.

    Raises:
        BadInput: the folder is missing, or a frame has no mask.
        BadImage: a mask is damaged or not of the video's size.
    """
    folder = Path(folder)
    if not folder.is_dir():
        raise BadInput("is not a folder", where=folder, field="--masks")
    numbered: dict[int, Path] = {}
    for path in sorted(folder.iterdir()):
        number = re.search(r"(\d+)$", path.stem)
        if number and path.suffix.lower() in (".png", ".jpg", ".jpeg", ".bmp"):
            numbered[int(number[1])] = path
    missing = [int(frame) for frame in indices if int(frame) not in numbered]
    if missing:
        raise BadInput(
            f"{len(missing)} of {len(indices)} frames have no mask: {bounded(missing)}",
            where=folder,
            field="--masks",
            remedy="Name the masks by the frame's number in the video, from 0: 000000.png, ...",
        )
    edge = working_size(windows)
    masks = np.zeros((len(indices), edge, edge), dtype=np.uint8)
    for row, frame in enumerate(indices):
        mask = read_gray(numbered[int(frame)], (info.height, info.width))
        masks[row] = resample(cut(mask, windows.corners[row], windows.side), edge)
    return masks


def read_frames(info: VideoInfo, selection: FrameRange) -> Iterator[tuple[int, np.ndarray]]:
    """Decode the selected frames, one after the other.

    Args:
        info: the probed video.
        selection: which frames; those between are decoded and dropped, because seeking is not
            exact in every container.

    Yields:
        (index in the video, (H, W, 3) uint8 RGB).

    Raises:
        BadInput: the size changes between frames, or the video ends before `selection.stop`.
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
            f"ends after {index} frames, {selection.stop} are selected",
            where=info.path,
            remedy="Choose other frames with --frames; the file may be truncated.",
        )


def _check_container(path: Path) -> None:
    """Refuse by its first bytes what is not a video file, before FFmpeg chooses a reader.

    FFmpeg also reads playlists, lists of files and descriptions of streams, which make it open
    other files or addresses of their author's choice.
    """
    try:
        with path.open("rb") as stream:
            head = stream.read(_HEAD)
    except OSError as error:
        raise BadInput(f"cannot be read ({error.strerror})", where=path) from error
    if not any(re.match(pattern, head, re.DOTALL) for pattern in CONTAINERS.values()):
        raise BadInput(
            f"is not a video file of a kind that is read ({', '.join(CONTAINERS)})",
            where=path,
            remedy="Convert it, such as with: ffmpeg -i VIDEO video.mp4",
        )


@contextlib.contextmanager
def _opened(path: Path) -> Iterator[Any]:
    import cv2

    if not path.is_file():
        raise BadInput("does not exist", where=path, remedy="Give a video file.")
    if path.stat().st_size == 0:
        raise BadInput("is empty (0 bytes)", where=path)
    _check_container(path)
    check_name(path)
    # FFmpeg would print what the file's headers say, terminal escapes too.
    os.environ.setdefault("OPENCV_FFMPEG_LOGLEVEL", "-8")
    capture = cv2.VideoCapture(os.fspath(path), cv2.CAP_FFMPEG)
    try:
        if not capture.isOpened():
            raise BadInput("is not a video that can be read", where=path)
        yield capture
    finally:
        capture.release()
