"""Decoding. Oracle: frames that were encoded, told apart by their gray level."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from synthetic_clip import write_video

from hwp_bench.base.errors import BadInput, UsageError
from hwp_bench.importers.video.decode import FrameRange, parse_frame_range, probe, read_frames

COUNT = 12


@pytest.fixture
def video(tmp_path: Path) -> Path:
    pictures = [np.full((48, 64, 3), 20 * k, dtype=np.uint8) for k in range(COUNT)]
    for picture in pictures:
        picture[:, :16] = (200, 30, 30)
    return write_video(tmp_path / "a.avi", pictures)


@pytest.mark.parametrize(
    ("text", "stride", "expected"),
    [
        (None, 1, range(COUNT)),
        (None, 5, range(0, COUNT, 5)),
        ("3:7", 1, range(3, 7)),
        ("3:", 2, range(3, COUNT, 2)),
        (":4", 3, range(0, 4, 3)),
    ],
)
def test_frames_come_in_order_and_in_rgb(
    video: Path, text: str | None, stride: int, expected: range
) -> None:
    selection = parse_frame_range(text, stride)
    info = probe(video)
    assert (info.width, info.height, info.fps, info.stated_frames) == (64, 48, 30.0, COUNT)
    frames = list(read_frames(info, selection))
    assert [index for index, _ in frames] == list(expected)
    assert selection.indices(COUNT).tolist() == list(expected)
    for index, picture in frames:
        # JPEG keeps a level to within a few.
        assert abs(float(picture[:, 32:].mean()) - 20 * index) < 4
        assert picture[24, 8, 0] > 150 > 80 > picture[24, 8, 2]


@pytest.mark.parametrize("text", ["", "5", "a:b", "7:3", "-2:4", "3:3", "1:2:3"])
def test_ranges_that_select_nothing_are_refused(text: str) -> None:
    with pytest.raises(UsageError):
        parse_frame_range(text, 1)
    with pytest.raises(UsageError):
        FrameRange(stride=0)


def test_a_range_beyond_the_end_is_refused(video: Path) -> None:
    with pytest.raises(BadInput, match="ends after 12 frames, 20 are selected"):
        list(read_frames(probe(video), FrameRange(0, 20)))


@pytest.mark.parametrize("content", [None, b"", b"this is no video" * 100, b"RIFF\0\0\0\0AVI "])
def test_what_is_no_video_is_refused(tmp_path: Path, content: bytes | None) -> None:
    path = tmp_path / "b.avi"
    if content is not None:
        path.write_bytes(content)
    with pytest.raises(BadInput) as caught:
        probe(path)
    assert caught.value.where == str(path)
