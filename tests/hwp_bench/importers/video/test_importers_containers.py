"""What is read as a video. Oracle: files of FFmpeg's own muxers, and lists that it would follow."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest

from hwp_bench.base.errors import BadInput
from hwp_bench.base.images import write_movie
from hwp_bench.importers.video.decode import FrameRange, probe, read_frames

FRAMES = [np.full((48, 64, 3), 40 * index, dtype=np.uint8) for index in range(4)]
# Of a transport stream FFmpeg must see some packets to know it.
LONG = [np.random.default_rng(0).integers(0, 255, (48, 64, 3), dtype=np.uint8)] * 60


@pytest.fixture
def video(tmp_path: Path) -> Path:
    return write_movie(tmp_path / "video.mp4", FRAMES, 30.0)


@pytest.mark.parametrize(
    ("ending", "codec"),
    [("mp4", "mpeg4"), ("mov", "mpeg4"), ("mkv", "mpeg4"), ("avi", "mpeg4"), ("ts", "mpeg2video"),
     ("mpg", "mpeg2video"), ("flv", "flv"), ("wmv", "wmv2"), ("webm", "libvpx")],
)  # fmt: skip
def test_every_container_of_the_list_is_read(tmp_path: Path, ending: str, codec: str) -> None:
    import av

    try:
        av.codec.Codec(codec, "w")
    except ValueError:
        pytest.skip(f"PyAV was built without {codec}")
    path = tmp_path / f"video.{ending}"
    with av.open(str(path), "w") as container:
        stream = container.add_stream(codec, rate=30)
        stream.width, stream.height, stream.pix_fmt = 64, 48, "yuv420p"
        for image in LONG:
            frame = av.VideoFrame.from_ndarray(image, format="rgb24")
            container.mux(stream.encode(frame))
        container.mux(stream.encode(None))
    info = probe(path)
    assert (info.width, info.height) == (64, 48)
    assert len(list(read_frames(info, FrameRange()))) == len(LONG)


@pytest.mark.parametrize(
    "content",
    [
        "ffconcat version 1.0\nfile video.mp4\nduration 1\n",
        "\nffconcat version 1.0\nfile 'video.mp4'\n",
        "#EXTM3U\n#EXT-X-TARGETDURATION:1\n#EXTINF:1,\nvideo.mp4\n#EXT-X-ENDLIST\n",
        "v=0\no=- 0 0 IN IP4 127.0.0.1\nm=video 5004 RTP/AVP 96\n",
        "<?xml version='1.0'?><MPD xmlns='urn:mpeg:dash:schema:mpd:2011'></MPD>",
        "frame000.png",
        "P6 4 4 255 ",
    ],
)
def test_lists_and_descriptions_are_refused(tmp_path: Path, video: Path, content: str) -> None:
    for ending in ("mp4", "ffconcat", "m3u8", "%03d.png"):
        path = tmp_path / f"list.{ending}"
        path.write_text(content)
        with pytest.raises(BadInput, match="not a video file of a kind that is read"):
            probe(path)


def test_a_list_would_be_followed_by_the_library(tmp_path: Path, video: Path) -> None:
    """The refusal above is not idle."""
    path = tmp_path / "list.mp4"
    path.write_text("ffconcat version 1.0\nfile video.mp4\nduration 1\n")
    assert cv2.VideoCapture(str(path)).isOpened()


def test_headers_of_a_video_do_not_reach_the_terminal(
    tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / "video.avi"
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*"MJPG"), 30, (64, 48))
    for image in FRAMES:
        writer.write(image)
    writer.release()
    path.write_bytes(path.read_bytes().replace(b"MJPG", b"\x1b[2J"))
    capfd.readouterr()
    with pytest.raises(BadInput):
        probe(path)
    said = capfd.readouterr()
    assert "\x1b" not in said.out + said.err
