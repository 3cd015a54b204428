"""The frames of a video: decoding them, and cutting the hand's window out of each."""

from __future__ import annotations

import contextlib
import os
import re
from collections.abc import Callable, Container, Generator, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, BinaryIO

import av
import numpy as np

from hwp_bench.base.console import notice
from hwp_bench.base.errors import BadInput, UsageError, bounded, check_name
from hwp_bench.base.files import check_is_file
from hwp_bench.base.images import MAX_PIXELS, read_gray
from hwp_bench.importers.shared.frames import CropWindows, ahead, cut, resample
from hwp_bench.importers.video.colours import Colours, colours_of, to_srgb


@dataclass(frozen=True)
class FrameRange:
    """The frames of a video that are used: start, start + stride, ... below stop."""

    #: First frame, counted from 0.
    start: int = 0
    #: End, not included; None = to the end.
    stop: int | None = None
    #: Step.
    stride: int = 1

    def __post_init__(self) -> None:
        if self.start < 0 or self.stride < 1 or (self.stop is not None and self.stop <= self.start):
            raise UsageError(
                f"{self.start}:{'' if self.stop is None else self.stop} with stride {self.stride} "
                "selects no frames",
                field="--range",
                remedy="Use A:B with 0 <= A < B, and a stride of at least 1.",
            )

    def indices(self, frame_count: int) -> np.ndarray:
        """Return the selected indices of a video of `frame_count` frames, (F,) int64."""
        stop = frame_count if self.stop is None else min(self.stop, frame_count)
        return np.arange(self.start, stop, self.stride)


def parse_frame_range(text: str | None, stride: int) -> FrameRange:
    """Read `A:B`, `A:` or `:B`."""
    if text is None:
        return FrameRange(stride=stride)
    head, colon, tail = text.partition(":")
    try:
        if not colon:
            raise ValueError
        return FrameRange(int(head or 0), int(tail) if tail else None, stride)
    except ValueError as error:
        raise UsageError(
            f"{text!r} is not a range", field="--range", remedy="Use A:B, A: or :B."
        ) from error


#: Containers that are read, each with FFmpeg's name of its reader and how its files begin.
CONTAINERS = {
    "MP4 or MOV": ("mov", rb".{4}(ftyp|moov|mdat|wide|free|skip|pnot)"),
    "Matroska or WebM": ("matroska", rb"\x1aE\xdf\xa3"),
    "AVI": ("avi", rb"RIFF.{4}AVI "),
    "MPEG transport stream": ("mpegts", rb"(?:.{4})?G.{187}(?:.{4})?G"),
    "MPEG": ("mpeg", rb"\0\0\x01\xba"),
    "MPEG without a container": ("mpegvideo", rb"\0\0\x01\xb3"),
    "Flash video": ("flv", rb"FLV\x01"),
    "Ogg": ("ogg", rb"OggS\0"),
    "ASF or WMV": ("asf", rb"\x30\x26\xb2\x75\x8e\x66\xcf\x11"),
}
_HEAD = 512
# Bytes that FFmpeg asks the file for at once.
_CHUNK = 1 << 18
#: A pixel may be at most this many times as wide as high, or as high as wide; what is stated
#: beyond is a fault of the file.
_MOST_ASPECT = 4
# Frames at the end of which one is the last that was recorded: they are stored in another order.
_TAIL = 4
# Packets of a stream that say that it is more than a picture, and all that are looked at for it.
_MOVING, _LOOK = 3, 20_000


@dataclass(frozen=True)
class VideoInfo:
    """Path, size and rate of a video."""

    #: The file.
    path: Path
    #: Pixels, after the rotation and the shape of pixels that the file asks for.
    width: int
    #: Pixels.
    height: int
    #: Frames per second; 30 where the file does not state it.
    fps: float
    #: Number of frames that the container states, 0 where it states none.
    stated_frames: int
    #: FFmpeg's name of what the frames are compressed by.
    codec: str = "unknown"
    #: How its samples are read, for a person.
    colours: str = "unknown"


@dataclass(frozen=True)
class Reading:
    """The outcome of reading a video to its end."""

    #: Number of frames that were decoded.
    frames: int
    #: Number that the container states, 0 where it states none.
    stated: int
    #: Whether the file ends before the video does.
    ends_early: bool
    #: Number of packets and frames that could not be decoded, or not whole.
    damaged: int

    def counted(self) -> str:
        """Return the number of frames, with that of the container where it is larger."""
        return f"{self.frames} of {self.stated}" if self.stated > self.frames else f"{self.frames}"

    def warning(self) -> str | None:
        """Say in what the video is not whole; None where it is."""
        said = []
        if self.ends_early:
            said.append(f"ends early, after {self.counted()} frames: the file is cut off")
        if self.damaged:
            said.append(f"damaged packets or frames: {self.damaged}")
        return "; ".join(said) or None

    def facts(self) -> dict[str, Any]:
        """Return the numbers, and the warning where there is one, for JSON."""
        said = self.warning()
        return {
            "decoded_frames": self.frames,
            "stated_frames": self.stated or None,
            "ends_early": self.ends_early,
            "damaged": self.damaged,
            **({} if said is None else {"warning": said}),
        }


def probe(path: str | os.PathLike[str]) -> VideoInfo:
    """Open a video and decode its first frame."""
    path = Path(path)
    with _opened(path) as video:
        _, frame, colours = next(video.frames(), (0, None, None))
        if frame is None:
            raise BadInput(
                f"contains no frame that can be decoded (codec {video.codec})",
                where=path,
                remedy=f"The file is damaged or cut off; if it plays elsewhere: {_AGAIN}",
            )
        size = video.upright_size(frame)
        return VideoInfo(path, *size, video.fps, video.stated, video.codec, str(colours))


def read_times(path: str | os.PathLike[str]) -> np.ndarray | None:
    """Read when each frame is shown, (F,) s from the first, without decoding any.

    None where the file does not say it, or has two frames within a millisecond.
    """
    stamps: list[float] = []
    with _opened(Path(path)) as video, contextlib.suppress(av.error.FFmpegError):
        for packet in video.packets():
            clock = packet.time_base
            if not video.has_clock or packet.pts is None or clock is None or clock >= 1:
                return None
            stamps.append(float(packet.pts * clock))
    times = np.sort(stamps)
    if len(times) < 2 or np.diff(times).min() < 1e-3:
        return None
    return np.asarray(times - times[0])


def count_frames(path: str | os.PathLike[str]) -> int:
    """Decode a video to its end and count its frames."""
    with _opened(Path(path)) as video:
        return sum(1 for _ in video.frames())


@dataclass(frozen=True, eq=False)
class ClipImages:
    """The frames of a clip at two resolutions."""

    #: (F, size, size, 3) uint8 RGB, as the capture stores them.
    frames: np.ndarray
    #: (F, S, S, 3) uint8 RGB, for cutting masks: the video's own resolution, at most twice the
    #: stored one.
    working: np.ndarray


def working_size(windows: CropWindows) -> int:
    """Edge of the working images, px."""
    return min(windows.side, 2 * windows.size)


def read_images(
    info: VideoInfo,
    selection: FrameRange,
    windows: CropWindows,
    update: Callable[[int], None] | None = None,
    ended: Callable[[Reading], None] | None = None,
) -> ClipImages:
    """Decode the video once and keep the window of every selected frame.

    `ended` is told as by `read_frames`.
    """
    count, edge = len(windows.corners), working_size(windows)
    frames = np.zeros((count, windows.size, windows.size, 3), dtype=np.uint8)
    working = np.zeros((count, edge, edge, 3), dtype=np.uint8)
    done = 0
    for _, image in ahead(read_frames(info, selection, ended)):
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

    The folder has images of the video's size whose names end in the frame number (`000012.png`,
    `frame_12.png`); above 127 is hand. Of F frames: (F, S, S) uint8 at the working resolution, 255
    = hand.
    """
    folder = Path(folder)
    if not folder.is_dir():
        raise BadInput("is not a folder", where=folder, field="--masks")
    numbered: dict[int, Path] = {}
    for path in sorted(folder.iterdir()):
        number = re.search(r"(\d+)$", path.stem)
        if number and path.suffix.lower() in (".png", ".jpg", ".jpeg", ".bmp"):
            other = numbered.setdefault(int(number[1]), path)
            if other != path:
                raise BadInput(
                    f"has two masks of frame {int(number[1])}: {other.name} and {path.name}",
                    where=folder,
                    field="--masks",
                    remedy="Give a folder with one mask a frame.",
                )
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


def read_frames(
    info: VideoInfo,
    selection: FrameRange,
    ended: Callable[[Reading], None] | None = None,
    wanted: Container[int] | None = None,
) -> Generator[tuple[int, np.ndarray]]:
    """Decode the selected frames: yields the index in the video, and (H, W, 3) uint8 sRGB.

    Those between are decoded and dropped, because seeking is not exact in every container. `ended`
    gets the outcome when the video was read to its end, which a `stop` prevents. Of the selected
    frames only those in `wanted` are converted and yielded; None: all.
    """
    with _opened(info.path) as video:
        index = 0
        for index, frame, colours in video.frames(selection.stop):
            if index < selection.start or (index - selection.start) % selection.stride:
                continue
            if wanted is not None and index not in wanted:
                continue
            if video.upright_size(frame) != (info.width, info.height):
                raise BadInput(
                    f"frame {index} is not of the size {info.width}x{info.height}",
                    where=info.path,
                    remedy="Re-encode the video, or import the frames of one size "
                    "(`hwp-bench data import video --range`).",
                )
            yield index, video.picture(frame, colours)
        if selection.stop is None:
            if ended is not None:
                ended(video.reading())
        elif video.decoded < selection.stop:
            raise BadInput(
                f"ends after {video.decoded} frames, {selection.stop} are selected",
                where=info.path,
                remedy="Choose other frames (`hwp-bench data import video --range`); the file may "
                "be truncated.",
            )


def warn_of_damage(info: VideoInfo, reading: Reading) -> None:
    """Say on standard error in what a video is not whole, if it is not."""
    said = reading.warning()
    if said is not None:
        notice(f"warning: {info.path} {said}. What it holds is used.")


_AGAIN = "ffmpeg -i VIDEO -c:v libx264 -crf 12 -pix_fmt yuv420p video.mp4"


class _Video:
    """An open file, a container of PyAV's, and the stream of it that is the video.

    `kind` is a key of `CONTAINERS`; the file may end within a packet of its container.
    """

    def __init__(self, path: Path, container: Any, kind: str, *, half_packet: bool) -> None:
        self._path, self._container = path, container
        self._stream = _choose(container, path)
        context = self._stream.codec_context
        self.codec: str = _codec_name(self._stream)
        _check_size(context.width, context.height, path)
        context.options = {"max_pixels": str(2 * MAX_PIXELS)}
        self._stream.thread_type = "AUTO"
        aspect = float(self._stream.sample_aspect_ratio or 1)
        self._aspect = aspect if 1 / _MOST_ASPECT <= aspect <= _MOST_ASPECT else 1.0
        rates = [self._stream.average_rate, self._stream.guessed_rate, context.framerate]
        if self._stream.time_base is not None and self._stream.time_base >= 1:
            # Such a clock counts no frames.
            rates = rates[2:]
        #: Frames per second; 30 where the file states none that can be.
        self.fps = next((float(rate) for rate in rates if rate and 0 < rate <= 1000), 30.0)
        self._packets, self._seconds, self._own = _expected(container, self._stream, kind)
        self.stated = int(self._stream.frames)
        if self._packets is not None:
            # An edit list may leave some out.
            discarded = sum(entry.is_discard for entry in self._stream.index_entries)
            self.stated = self._packets - discarded
        if self.stated <= 0 and self._seconds is not None:
            self.stated = max(0, min(round(self._seconds * self.fps), 2**31 - 1))
        # What FFmpeg makes up for a bare stream jumps.
        self.has_clock = kind != "MPEG without a container"
        # Half of a packet at the end, of a row of packets of one size.
        self._cut = half_packet
        self.decoded = self._damaged = self._seen = 0
        self._damaged_at, self._rows = -_TAIL, kind == "MPEG transport stream"
        self._reached = 0.0
        self._known: dict[tuple[Any, ...], Colours] = {}
        self._turn: tuple[bool, bool, bool] | None = None

    def frames(self, stop: int | None = None) -> Iterator[tuple[int, Any, Colours]]:
        """Decode the video; yields the number of each frame, the frame and its colours."""
        for packet in self._packets_of_file():
            try:
                frames = packet.decode()
            except av.error.FFmpegError:
                self._damaged += 1
                continue
            for frame in frames:
                if stop is not None and self.decoded >= stop:
                    return
                self._damaged += bool(frame.is_corrupt) and not packet.is_corrupt
                self.decoded += 1
                if frame.is_corrupt:
                    self._damaged_at = self.decoded
                yield self.decoded - 1, frame, self._colours(frame)

    def packets(self) -> Iterator[Any]:
        """Packets of the frames that are shown, in the order of the file."""
        for packet in self._packets_of_file():
            if packet.size and not packet.is_discard:
                yield packet

    def _packets_of_file(self) -> Iterator[Any]:
        """Packets of the video; takes note of how far those of all streams reach.

        A last packet that is not whole is left out: its error, at the end, would take the frames
        with it that the decoder's threads still have, so that their number would decide.
        """
        streams, own = self._container.streams, self._stream.index
        held = None
        others = () if self._own else (*streams.audio, *streams.video)
        wanted = [self._stream, *(one for one in others if one.index != own)]
        packets = iter(self._container.demux(wanted))
        while True:
            try:
                packet = next(packets, None)
            except av.error.FFmpegError:
                self._damaged += 1
                self._cut = True
                return
            if packet is None:
                self._cut |= held is not None
                return
            if packet.pts is not None and packet.size:
                end = float((packet.pts + (packet.duration or 0)) * packet.time_base)
                # Less the second at which the time of the stream begins.
                if self._own:
                    began = float((packet.stream.start_time or 0) * packet.stream.time_base)
                else:
                    began = (self._container.start_time or 0) / av.time_base
                self._reached = max(self._reached, end - began)
            if packet.stream.index == own:
                self._seen += packet.size > 0
                self._damaged += bool(packet.is_corrupt)
                if held is not None and packet.size:
                    yield held
                    held = None
                if packet.is_corrupt:
                    held = packet
                else:
                    yield packet

    def _colours(self, frame: Any) -> Colours:
        stated = (frame.colorspace, frame.color_primaries, frame.color_trc, frame.color_range)
        key = (*stated, frame.format.name, frame.width, frame.height)
        if key not in self._known:
            tag = self._stream.codec_context.codec_tag
            self._known = {key: colours_of(frame, tag, self._path)}
        return self._known[key]

    def reading(self) -> Reading:
        """Print the result after the last frame."""
        # Where no length is stated, a damaged frame among the last is the sign of an end.
        cut = self._cut or (self._rows and self._damaged_at > self.decoded - _TAIL)
        if self._packets is not None:
            cut |= self._seen < self._packets
        elif self._seconds is not None:
            # The last frame may be shown for longer than the others.
            cut |= self._seconds - self._reached > max(2.5 / self.fps, 0.01 * self._seconds)
        return Reading(self.decoded, self.stated, cut, self._damaged)

    def _shown_size(self, frame: Any) -> tuple[int, int]:
        """Width and height of a frame with square pixels, before it is turned."""
        width, height = frame.width, frame.height
        if self._aspect > 1.0:
            width = round(width * self._aspect)
        elif self._aspect < 1.0:
            height = round(height / self._aspect)
        _check_size(width, height, self._path)
        return width, height

    def _turned(self, frame: Any) -> tuple[bool, bool, bool]:
        """How a frame is turned for display: rows become columns, rows and columns reversed.

        The display matrix maps a pixel's column and row to those of the display; the nearest of its
        eight turns and mirror images is taken. It is that of the first frame: one whose side data
        are looked at is part of a ring of objects, and stays in memory until Python looks for
        garbage.
        """
        if self._turn is None:
            self._turn = False, False, False
            stated = next((s for s in frame.side_data if s.type.name == "DISPLAYMATRIX"), None)
            if stated is not None:
                a, b, _, c, d = (int(value) for value in np.frombuffer(stated, np.int32)[:5])
                swapped = max(abs(b), abs(c)) > max(abs(a), abs(d))
                self._turn = (True, b < 0, c < 0) if swapped else (False, d < 0, a < 0)
        return self._turn

    def upright_size(self, frame: Any) -> tuple[int, int]:
        """Width and height of a frame as it is shown."""
        width, height = self._shown_size(frame)
        return (height, width) if self._turned(frame)[0] else (width, height)

    def picture(self, frame: Any, colours: Colours) -> np.ndarray:
        """A frame as it is shown, (H, W, 3) uint8 sRGB."""
        image = to_srgb(frame, colours, self._shown_size(frame))
        swapped, up, back = self._turned(frame)
        if swapped:
            image = image.transpose(1, 0, 2)
        image = image[:: -1 if up else 1, :: -1 if back else 1]
        return np.ascontiguousarray(image)


def _expected(container: Any, stream: Any, kind: str) -> tuple[int | None, float | None, bool]:
    """Read the length that a file states."""
    if kind == "MP4 or MOV" and stream.frames > 0:
        # What an edit list leaves out is not among them.
        return len(stream.index_entries), None, True
    if kind == "AVI" and stream.frames > 0 and stream.average_rate:
        return None, stream.frames / float(stream.average_rate), True
    stated = re.fullmatch(r"(\d+):(\d\d):(\d\d(?:\.\d+)?)", stream.metadata.get("DURATION", ""))
    if stated:
        return None, int(stated[1]) * 3600 + int(stated[2]) * 60 + float(stated[3]), True
    if stream.duration and stream.time_base and kind != "AVI":
        return None, float(stream.duration * stream.time_base), True
    if container.duration and container.duration > 0:
        return None, container.duration / av.time_base, False
    return None, None, True


def _choose(container: Any, path: Path) -> Any:
    """The stream that is the video: not a cover, not a preview, decodable, marked, the largest."""
    streams = list(container.streams.video)
    if not streams:
        raise BadInput("contains no video", where=path, remedy="It may hold sound only.")
    flags = av.stream.Disposition
    pictures = flags.attached_pic | flags.timed_thumbnails | flags.still_image
    moving = [stream for stream in streams if not stream.disposition & pictures]
    if len(moving) > 1:
        moving = _with_frames(container, moving)
    if not moving:
        raise BadInput("contains no video but a cover picture", where=path)
    readable = [one for one in moving if one.codec_context and one.codec_context.codec]
    if not readable:
        names = ", ".join(_codec_name(stream) for stream in moving)
        raise BadInput(
            f"is compressed by a codec that cannot be decoded here ({names})",
            where=path,
            remedy=f"Convert it: {_AGAIN}",
        )

    def rank(stream: Any) -> tuple[bool, bool, int]:
        area = stream.codec_context.width * stream.codec_context.height
        marked = bool(stream.disposition & flags.default)
        return not stream.disposition & flags.dependent, marked, area

    return max(readable, key=rank)


def _with_frames(container: Any, streams: list[Any]) -> list[Any]:
    """Those of some streams that hold more than a picture or two, as the first packets show."""
    counts = dict.fromkeys((stream.index for stream in streams), 0)
    with contextlib.suppress(av.error.FFmpegError):
        for number, packet in enumerate(container.demux(streams)):
            counts[packet.stream.index] += packet.size > 0
            if number > _LOOK or min(counts.values()) >= _MOVING:
                break
    container.seek(0)
    most = min(max(counts.values()), _MOVING)
    return [stream for stream in streams if counts[stream.index] >= most]


def _codec_name(stream: Any) -> str:
    context = stream.codec_context
    if context is None:
        return "unknown"
    # The decoder may be named after its library.
    return {"libdav1d": "av1"}.get(context.name, context.name)


def _check_size(width: int, height: int, path: Path) -> None:
    if width * height > MAX_PIXELS:
        raise BadInput(
            f"is {width}x{height}, above the limit of {MAX_PIXELS} px per frame", where=path
        )


def _kind(path: Path, stream: BinaryIO) -> tuple[str, int]:
    """The container by the file's first bytes, so that FFmpeg does not choose its reader itself.

    It also reads playlists, lists of files and descriptions of streams, which make it open other
    files or addresses of their author's choice. With it the size of its packets, 1 for most.
    """
    head = stream.read(_HEAD)
    stream.seek(0)
    for kind, (_, pattern) in CONTAINERS.items():
        if re.match(pattern, head, re.DOTALL):
            # Transport streams are rows of packets of 188 bytes, on discs and in cameras of 192.
            rows = 188 if head[:1] == head[188:189] == b"G" else 192
            return kind, rows if kind == "MPEG transport stream" else 1
    raise BadInput(
        f"is not a video file of a kind that is read ({', '.join(CONTAINERS)})",
        where=path,
        remedy="Convert it, such as with: ffmpeg -i VIDEO video.mp4",
    )


@contextlib.contextmanager
def _opened(path: Path) -> Iterator[_Video]:
    check_name(path)
    check_is_file(path, remedy="Give a video file.")
    size = path.stat().st_size
    if size == 0:
        raise BadInput("is empty (0 bytes)", where=path)
    with contextlib.ExitStack() as stack:
        try:
            stream = stack.enter_context(path.open("rb"))
            kind, packet = _kind(path, stream)
            container = stack.enter_context(_container(stream, kind))
        except OSError as error:
            if not isinstance(error, av.error.FFmpegError):
                raise BadInput(f"cannot be read ({error.strerror})", where=path) from error
            raise _unreadable(path, kind) from error
        except (ValueError, av.error.FFmpegError) as error:
            raise _unreadable(path, kind) from error
        yield _Video(path, container, kind, half_packet=size % packet != 0)


def _container(stream: BinaryIO, kind: str) -> Any:
    """Open a container of an open file: no name is taken for an address."""
    reader, _ = CONTAINERS[kind]
    container = av.open(stream, format=reader, buffer_size=_CHUNK)
    clocks = [one.time_base for one in container.streams.video if one.time_base is not None]
    if kind == "MP4 or MOV" and clocks and min(clocks) >= 1:
        # A clock of whole seconds is a fault (a time scale of 0), and by it edits leave frames out.
        container.close()
        stream.seek(0)
        options = {"advanced_editlist": "0"}
        container = av.open(stream, format=reader, buffer_size=_CHUNK, options=options)
    return container


def _unreadable(path: Path, kind: str) -> BadInput:
    remedy = f"If it plays elsewhere: {_AGAIN}"
    if kind == "MP4 or MOV":
        remedy = f"A file that was cut off has lost its index, which stands at its end. {remedy}"
    return BadInput(f"is damaged or no video ({kind})", where=path, remedy=remedy)
