"""Which frames of a file are its video, and whether they are all there.

Oracle: frames that were encoded; OpenCV's direction; the arithmetic of ISO 14496-12's matrices.
"""

from __future__ import annotations

import gc
import os
import socket
from collections.abc import Callable
from fractions import Fraction
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from encoded_video import pictures, silence, write_pictures

from hwp_bench.base.errors import BadInput
from hwp_bench.base.images import read_gray
from hwp_bench.cli.main import main
from hwp_bench.importers.video import decode
from hwp_bench.importers.video.decode import (
    FrameRange,
    Reading,
    VideoInfo,
    probe,
    read_frames,
    read_times,
)

COUNT = 24
#: H.264 whose frames stand alone, so that each that is in the file can be shown.
ALONE = {"g": "1", "bf": "0"}
FIRST = {"movflags": "faststart"}


def read(path: Path) -> tuple[VideoInfo, list[np.ndarray], Reading]:
    info, endings = probe(path), list[Reading]()
    frames = [image for _, image in read_frames(info, FrameRange(), endings.append)]
    return info, frames, endings[0]


def greys(frames: list[np.ndarray]) -> list[int]:
    """Numbers of frames of `pictures`, by their grey."""
    return [round(float(image[:, :24].mean()) / 9) for image in frames]


def cut(path: Path, share: float = 0.6) -> Path:
    """The first part of a file, no whole number of packets of a transport stream."""
    content = path.read_bytes()
    short = path.with_name(f"cut_{path.name}")
    short.write_bytes(content[: int(share * len(content)) // 188 * 188 + 100])
    return short


@pytest.mark.parametrize(
    ("codec", "ending"),
    [("libsvtav1", "mp4"), ("libsvtav1", "mkv"), ("libx265", "mov"), ("libvpx-vp9", "webm"),
     ("libvpx", "webm"), ("prores_ks", "mov"), ("ffv1", "mkv")],
)  # fmt: skip
def test_codecs_of_phones_and_browsers(tmp_path: Path, codec: str, ending: str) -> None:
    options = {"libsvtav1": {"preset": "11", "svtav1-params": "lp=1"},
               "libx265": {"x265-params": "log-level=none"}}  # fmt: skip
    pix_fmt = "yuv422p10le" if codec == "prores_ks" else "yuv420p"
    path = write_pictures(
        tmp_path / f"a.{ending}", pictures(COUNT), codec, pix_fmt=pix_fmt,
        options=options.get(codec, {}),
    )  # fmt: skip
    info, frames, reading = read(path)
    assert greys(frames) == list(range(COUNT))
    assert info.stated_frames == COUNT
    assert reading == Reading(COUNT, COUNT, ends_early=False, damaged=0)
    assert reading.warning() is None


def write_with_cover(path: Path, *, default: bool) -> Path:
    """A picture, larger than the video, as the first stream of a file."""
    import av

    with av.open(str(path), "w") as container:
        cover = container.add_stream("mjpeg", rate=1)
        cover.width, cover.height, cover.pix_fmt = 320, 240, "yuvj420p"
        stream = container.add_stream("libx264", rate=30)
        stream.width, stream.height, stream.pix_fmt = 64, 48, "yuv420p"
        if default:
            cover.disposition = av.stream.Disposition.default
        shown = av.VideoFrame.from_ndarray(np.full((240, 320, 3), 99, np.uint8), format="rgb24")
        shown.pts = 0
        container.mux(cover.encode(shown))
        container.mux(cover.encode(None))
        for image in pictures(COUNT):
            container.mux(stream.encode(av.VideoFrame.from_ndarray(image, format="rgb24")))
        container.mux(stream.encode(None))
    return path


@pytest.mark.parametrize("default", [False, True])
@pytest.mark.parametrize("ending", ["mkv", "mp4"])
def test_a_cover_is_not_the_video(tmp_path: Path, ending: str, default: bool) -> None:
    info, frames, reading = read(write_with_cover(tmp_path / f"a.{ending}", default=default))
    assert (info.width, info.height) == (64, 48)
    assert greys(frames) == list(range(COUNT))
    assert reading.warning() is None


def test_an_attached_picture_is_not_the_video(tmp_path: Path) -> None:
    import av

    encoded, jpeg = cv2.imencode(".jpg", np.full((240, 320, 3), 99, np.uint8))
    assert encoded
    with av.open(str(tmp_path / "video.mkv"), "w") as container:
        stream = container.add_stream("libx264", rate=30)
        container.add_attachment("cover.jpg", "image/jpeg", jpeg.tobytes())
        stream.width, stream.height, stream.pix_fmt = 64, 48, "yuv420p"
        for image in pictures(COUNT):
            container.mux(stream.encode(av.VideoFrame.from_ndarray(image, format="rgb24")))
        container.mux(stream.encode(None))
    with av.open(str(tmp_path / "song.mkv"), "w") as container:
        noise = container.add_stream("aac", rate=44100)
        container.add_attachment("cover.jpg", "image/jpeg", jpeg.tobytes())
        container.mux(noise.encode(silence(1.0)))
        container.mux(noise.encode(None))
    info, frames, _ = read(tmp_path / "video.mkv")
    assert (info.width, len(frames)) == (64, COUNT)
    with pytest.raises(BadInput, match="no video but a cover picture"):
        probe(tmp_path / "song.mkv")


def patched(path: Path, box: bytes, offset: int, value: bytes) -> Path:
    """Overwrite bytes of an MP4 box, counted from the end of its name."""
    content = bytearray(path.read_bytes())
    begin = content.index(box) + len(box) + offset
    content[begin : begin + len(value)] = value
    other = path.with_name(f"patched_{path.name}")
    other.write_bytes(content)
    return other


def test_a_clock_of_no_steps_loses_no_frame(tmp_path: Path) -> None:
    """A time scale of 0 in mdhd. Oracle: the same file with its clock."""
    path = write_pictures(tmp_path / "a.mp4", pictures(COUNT))
    info, frames, reading = read(patched(path, b"mdhd", 12, bytes(4)))
    whole = read(path)[1]
    assert len(frames) == COUNT
    for image, truth in zip(frames, whole, strict=True):
        np.testing.assert_array_equal(image, truth)
    assert info.fps == 30.0
    assert reading.warning() is None


def test_an_edited_video_is_whole(tmp_path: Path) -> None:
    """An edit list shows the first third of a second of 0.8 s."""
    path = write_pictures(tmp_path / "a.mp4", pictures(COUNT), options={"bf": "0"})
    info, frames, reading = read(patched(path, b"elst", 8, (333).to_bytes(4, "big")))
    assert greys(frames) == list(range(len(frames)))
    assert len(frames) == info.stated_frames == 10
    assert reading.warning() is None


TURNS = {
    (1, 0, 0, 1): None, (0, 1, -1, 0): cv2.ROTATE_90_CLOCKWISE, (-1, 0, 0, -1): cv2.ROTATE_180,
    (0, -1, 1, 0): cv2.ROTATE_90_COUNTERCLOCKWISE, (-1, 0, 0, 1): "mirrored",
    (1, 0, 0, -1): "mirrored", (0, 1, 1, 0): "mirrored", (0, -1, -1, 0): "mirrored",
}  # fmt: skip


@pytest.mark.parametrize(
    ("matrix", "aspect"),
    [*((matrix, Fraction(1)) for matrix in TURNS), ((0, 1, -1, 0), Fraction(3, 2))],
)
def test_frames_are_upright(
    tmp_path: Path, matrix: tuple[int, int, int, int], aspect: Fraction
) -> None:
    """Each place goes where the display matrix maps it; pixels become square before."""
    images = [np.full((48, 64, 3), 128, np.uint8)] * 2
    for image in images:
        image[4:20, 6:22] = 250  # near the upper left corner
        image[:, 56:] = 20
    path = write_pictures(tmp_path / "a.mp4", images, aspect=aspect)
    turned = patched(path, b"tkhd", 40, b"".join(_fixed(matrix)))
    info, frames, _ = read(turned)
    a, b, c, d = matrix
    height, width = 48, round(64 * aspect)
    places = {250: (14 * aspect, 12), 20: (60 * aspect, 30)}
    for level, (x, y) in places.items():
        column = a * x + c * y + (width if a < 0 else height if c < 0 else 0)
        row = b * x + d * y + (width if b < 0 else height if d < 0 else 0)
        assert abs(float(frames[0][int(row), int(column)].mean()) - level) < 12
    assert (info.width, info.height) == ((width, height) if a else (height, width))
    if aspect == 1 and TURNS[matrix] != "mirrored":
        seen = cv2.VideoCapture(str(turned)).read()[1][:, :, ::-1]
        np.testing.assert_array_equal(frames[0], seen)


def _fixed(matrix: tuple[int, int, int, int]) -> list[bytes]:
    a, b, c, d = (value << 16 for value in matrix)
    values = (a, b, 0, c, d, 0, 0, 0, 1 << 30)
    return [value.to_bytes(4, "big", signed=True) for value in values]


def test_frames_do_not_stay_in_memory(tmp_path: Path) -> None:
    """Also where Python looks for no garbage: a frame of a phone takes 12 MB and more."""
    import av

    path = write_pictures(tmp_path / "a.mp4", pictures(COUNT))
    info = probe(path)
    gc.collect()
    gc.disable()
    try:
        assert sum(1 for _ in read_frames(info, FrameRange())) == COUNT
        held = sum(type(one) is av.VideoFrame for one in gc.get_objects())
    finally:
        gc.enable()
    # The first frame, whose marks are read; the library may hold one.
    assert held <= 2


def test_pixels_that_are_not_square(tmp_path: Path) -> None:
    """Wide pixels make the frame wider, high ones higher; what cannot be is ignored."""
    for aspect, size in (
        (Fraction(4, 3), (85, 48)),
        (Fraction(3, 4), (64, 64)),
        (Fraction(4000, 3999), (64, 48)),
        (Fraction(90, 1), (64, 48)),
    ):
        info = probe(write_pictures(tmp_path / "a.mp4", pictures(2), aspect=aspect))
        assert (info.width, info.height) == size, aspect


def test_odd_sizes_and_steps_of_time(tmp_path: Path) -> None:
    """33 and 67 ms between frames, as phones have them in the dark, lose and double none."""
    import av

    path = tmp_path / "a.mkv"
    images = pictures(COUNT, (63, 47))
    with av.open(str(path), "w") as container:
        stream = container.add_stream("ffv1", rate=30)
        stream.width, stream.height, stream.pix_fmt = 63, 47, "bgr0"
        stream.codec_context.time_base = Fraction(1, 1000)
        for number, image in enumerate(images):
            frame = av.VideoFrame.from_ndarray(image, format="rgb24")
            frame.pts, frame.time_base = number * 50 + 17 * (number % 2), Fraction(1, 1000)
            container.mux(stream.encode(frame))
        container.mux(stream.encode(None))
    info, frames, reading = read(path)
    assert (info.width, info.height) == (63, 47)
    np.testing.assert_array_equal(frames, images)
    assert reading.warning() is None


#: ms between frames, as phones have them: most of 30 a second, some dropped, some late.
STEPS = [33, 34, 33, 67, 33, 35, 100, 33] * 3


@pytest.mark.parametrize(
    ("ending", "codec"),
    [("mp4", "libx264"), ("mov", "libx265"), ("mkv", "libx264"), ("webm", "libvpx-vp9"),
     ("ts", "libx264"), ("flv", "libx264")],
)  # fmt: skip
def test_times_of_frames_are_read(tmp_path: Path, ending: str, codec: str) -> None:
    """Also where frames are stored in another order. Tolerance: a tick of the container's clock."""
    times = np.cumsum([40, *STEPS[: COUNT - 1]])
    quiet = {"x265-params": "log-level=none"} if codec == "libx265" else {}
    path = write_pictures(
        tmp_path / f"a.{ending}", pictures(COUNT), codec, options=quiet, times=times.tolist()
    )
    found = read_times(path)
    assert found is not None
    np.testing.assert_allclose(found, (times - times[0]) / 1000, atol=1e-3)
    assert len(found) == len(read(path)[1])


def test_a_video_without_a_clock_has_no_times(tmp_path: Path) -> None:
    raw = write_pictures(tmp_path / "a.mpg", pictures(COUNT), "mpeg1video")
    import av

    with av.open(str(raw)) as container:
        content = b"".join(bytes(packet) for packet in container.demux(video=0))
    (tmp_path / "raw.m1v").write_bytes(content)
    assert read_times(tmp_path / "raw.m1v") is None
    whole = write_pictures(tmp_path / "a.mp4", pictures(COUNT))
    assert read_times(patched(whole, b"mdhd", 12, bytes(4))) is None
    doubled = write_pictures(
        tmp_path / "b.mkv", pictures(3), "ffv1", pix_fmt="bgr0", times=[0, 40, 40]
    )
    assert read_times(doubled) is None


@pytest.mark.parametrize(
    ("ending", "codec", "options", "count"),
    [("mkv", "libx264", {}, "of 24"), ("webm", "libvpx-vp9", {}, "of 24"),
     ("avi", "mjpeg", {}, "of 24"), ("mp4", "libx264", FIRST, "of 24"),
     ("flv", "libx264", {}, "of 24"), ("ts", "libx264", {}, "frames")],
)  # fmt: skip
def test_a_video_that_ends_early_says_so(
    tmp_path: Path, ending: str, codec: str, options: dict[str, str], count: str
) -> None:
    """A transport stream states no length; that its last packet is cut tells."""
    pix_fmt = "yuvj420p" if codec == "mjpeg" else "yuv420p"
    path = write_pictures(
        tmp_path / f"a.{ending}", pictures(COUNT), codec, pix_fmt=pix_fmt,
        options=ALONE if codec == "libx264" else {}, container_options=options,
    )  # fmt: skip
    assert read(path)[2].warning() is None
    _, frames, reading = read(cut(path))
    assert 6 < len(frames) < 20
    # The last one may be cut too.
    assert greys(frames[:-1]) == list(range(len(frames) - 1))
    assert reading.ends_early
    assert reading.frames == len(frames)
    said = reading.warning() or ""
    assert said.startswith(f"ends early, after {len(frames)} ")
    assert count in said


@pytest.mark.parametrize(("ending", "options"), [("mp4", FIRST), ("flv", {})])
def test_threads_do_not_decide_how_many_frames_of_a_cut_video_are_read(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, ending: str, options: dict[str, str]
) -> None:
    """Oracle: all packets but the last, of which the file has a part, and one thread's pixels."""
    whole = tmp_path / f"a.{ending}"
    path = cut(write_pictures(whole, pictures(COUNT), container_options=options))
    stamps = read_times(path)
    assert stamps is not None
    choose, found = decode._choose, []
    for threads in (1, 2, 4):

        def chosen(container: Any, where: Path, threads: int = threads) -> Any:
            stream = choose(container, where)
            stream.codec_context.thread_count = threads
            return stream

        monkeypatch.setattr(decode, "_choose", chosen)
        _, frames, reading = read(path)
        assert len(frames) == len(stamps)
        assert reading.ends_early
        found.append(frames)
    for other in found[1:]:
        np.testing.assert_array_equal(other, found[0])


def test_a_transport_stream_that_ends_between_packets(tmp_path: Path) -> None:
    """It states no length; that its last frame is not whole tells."""
    path = write_pictures(tmp_path / "a.ts", pictures(COUNT), options=ALONE)
    short = tmp_path / "cut.ts"
    short.write_bytes(path.read_bytes()[: path.stat().st_size // 2 // 188 * 188])
    _, frames, reading = read(short)
    assert reading.ends_early
    assert (reading.warning() or "").startswith(f"ends early, after {len(frames)} ")


@pytest.mark.parametrize("sound", [0.4, 3.0])
@pytest.mark.parametrize("ending", ["mp4", "mkv"])
def test_sound_that_is_longer_or_shorter_is_no_damage(
    tmp_path: Path, ending: str, sound: float
) -> None:
    path = write_pictures(tmp_path / f"a.{ending}", pictures(COUNT), sound=sound)
    assert read(path)[2] == Reading(COUNT, COUNT, ends_early=False, damaged=0)
    if ending == "mkv":
        # Other programs write no length of single streams.
        path.write_bytes(path.read_bytes().replace(b"DURATION", b"DURATIOX"))
        reading = read(path)[2]
        assert (reading.frames, reading.warning()) == (COUNT, None)


def test_damage_in_the_middle_is_counted(tmp_path: Path) -> None:
    path = write_pictures(tmp_path / "a.mp4", pictures(COUNT), options=ALONE)
    content = bytearray(path.read_bytes())
    middle = content.index(b"mdat") + 2000
    content[middle : middle + 400] = bytes(400)
    path.write_bytes(content)
    _, frames, reading = read(path)
    assert len(frames) >= COUNT - 6
    assert reading.damaged >= 1
    assert not reading.ends_early
    assert f"damaged packets or frames: {reading.damaged}" in (reading.warning() or "")


def test_sound_alone_and_a_lost_index_are_named(
    tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    """One line each, and nothing of the libraries."""
    import av

    sound = tmp_path / "sound.mp4"
    with av.open(str(sound), "w") as container:
        stream = container.add_stream("aac", rate=44100)
        container.mux(stream.encode(silence(1.0)))
        container.mux(stream.encode(None))
    lost = cut(write_pictures(tmp_path / "a.mp4", pictures(COUNT)))
    capfd.readouterr()
    for path, named in ((sound, "contains no video"), (lost, "has lost its index")):
        assert main(["data", "track", str(path)]) == 1
        said = capfd.readouterr().err
        assert named in said
        assert said.count("\n") == 1
        assert "WARN" not in said


def _folder(path: Path) -> None:
    path.mkdir()


def _pipe(path: Path) -> None:
    os.mkfifo(path)


def _socket(path: Path) -> None:
    with socket.socket(socket.AF_UNIX) as made:
        made.bind(str(path))


@pytest.mark.parametrize(
    ("make", "named"), [(_folder, "a folder"), (_pipe, "a pipe"), (_socket, "a socket")]
)
def test_what_is_no_file_is_named(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, make: Callable[[Path], None], named: str
) -> None:
    """In the place of a video, a frame or a mask; a pipe would be waited for."""
    # Names of sockets are short.
    monkeypatch.chdir(tmp_path)
    path = Path("a.png")
    make(path)
    for opens in (probe, read_gray):
        with pytest.raises(BadInput, match=f"is {named} where a file is expected"):
            opens(path)
        with pytest.raises(BadInput, match="does not exist"):
            opens(Path("none.png"))


def test_an_encoder_leaves_no_real_time_process(tmp_path: Path) -> None:
    options = {"preset": "11", "svtav1-params": "lp=1"}
    write_pictures(tmp_path / "clip.mp4", pictures(COUNT), "libsvtav1", options=options)
    policies = {os.sched_getscheduler(int(t)) for t in os.listdir("/proc/self/task")}
    assert policies == {os.SCHED_OTHER}
