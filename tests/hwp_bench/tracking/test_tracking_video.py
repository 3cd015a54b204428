"""`hwp-bench data track`. Oracle: videos of discs; what the importer reads of the result."""

from __future__ import annotations

import json
import re
import sys
from pathlib import Path

import cv2
import numpy as np
import pytest
from encoded_video import write_pictures
from fake_networks import LAYOUT, RADIUS, SIZE, FakeNetworks, picture

from hwp_bench.base.arrays import write_npz
from hwp_bench.base.errors import BadInput
from hwp_bench.cli.main import main
from hwp_bench.importers.shared.landmarks import read_association, read_hand_tracks, read_landmarks
from hwp_bench.tracking import track_video
from hwp_bench.tracking.track_video import NoHandSeen


def write_video(path: Path, clip: list[dict[str, tuple[float, float]]]) -> Path:
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*"MJPG"), 30, SIZE)
    for discs in clip:
        writer.write(np.ascontiguousarray(picture(discs)[:, :, ::-1]))
    writer.release()
    return path


@pytest.fixture
def video(tmp_path: Path) -> Path:
    """A left hand in eight frames, and a right one in the first four."""
    clip: list[dict[str, tuple[float, float]]] = [{"left": (40 + k, 60)} for k in range(8)]
    for k in range(4):
        clip[k]["right"] = (120, 60)
    return write_video(tmp_path / "hands.avi", clip)


def test_the_importer_reads_each_hand(video: Path, tmp_path: Path) -> None:
    out = tmp_path / "hands.npz"
    tracked = track_video(video, out, networks=FakeNetworks())
    assert sorted(path.name for path in tmp_path.iterdir()) == ["hands.avi", "hands.npz"]
    left = read_landmarks(out, min_score=0.5, side="left")
    np.testing.assert_allclose(left.image[0], [40, 60] + LAYOUT * RADIUS, atol=2)
    assert left.detected.all()
    right = read_landmarks(out, min_score=0.5, side="right")
    np.testing.assert_array_equal(right.detected, np.arange(8) < 4)
    # A reader of version 1 finds the hand that is seen most.
    np.testing.assert_array_equal(read_landmarks(out, min_score=0.5).image, left.image)
    found = read_association(out)
    assert found is not None
    assert found.sides == ("left", "right")
    read = read_hand_tracks(out)
    assert read is not None
    assert read.size == SIZE
    for name in ("image", "world", "score", "right", "track"):
        np.testing.assert_array_equal(getattr(read, name), getattr(tracked.hands, name))


def test_votes_of_the_hand_that_is_read(tmp_path: Path) -> None:
    video = write_video(tmp_path / "one.avi", [{"right": (60, 60)}] * 5)
    track_video(video, tmp_path / "one.npz", networks=FakeNetworks())
    found = read_association(tmp_path / "one.npz")
    assert found is not None
    for side in ("right", "left"):
        assert found.votes(side) == pytest.approx({"right": 0.95, "left": 0.05})
    # Files of version 1 say nothing of sides.
    arrays = {"image": np.ones((1, 21, 3)), "world": np.ones((1, 21, 3)), "score": np.ones(1)}
    old = write_npz(tmp_path / "old.npz", arrays)
    assert read_association(old) is None
    newer = write_npz(tmp_path / "newer.npz", {**arrays, "version": np.array([3])})
    with pytest.raises(BadInput, match="newer version"):
        read_hand_tracks(newer)


def test_the_command(
    video: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    from hwp_bench.tracking import track_video as module_function  # noqa: F401

    module = sys.modules["hwp_bench.tracking.track_video"]
    monkeypatch.setattr(module, "load_models", lambda model: None)
    monkeypatch.setattr(module, "LiteRtNetworks", lambda models: FakeNetworks())
    sheet = video.with_name("sheet.png")
    assert main(["data", "track", str(video), "--sheet", str(sheet), "--json"]) == 0
    facts = json.loads(capsys.readouterr().out)
    assert facts["frames"] == 8
    assert [hand["side"] for hand in facts["hands"]] == ["left", "right"]
    assert [hand["frames_seen"] for hand in facts["hands"]] == [8, 4]
    assert sheet.stat().st_size > 1000
    assert main(["data", "track", str(video)]) == 2
    assert "exists already" in capsys.readouterr().err
    assert main(["data", "track", str(video), "--overwrite"]) == 0
    assert "left hand: seen in 8 frames" in capsys.readouterr().out
    empty = write_video(video.with_name("empty.avi"), [{}] * 3)
    assert main(["data", "track", str(empty)]) == 1
    said = capsys.readouterr().err
    assert "none of 3 frames shows a hand" in said
    assert "Traceback" not in said
    assert not empty.with_suffix(".npz").exists()


def test_a_sheet_without_hands_is_written_only_where_it_is_asked_for(tmp_path: Path) -> None:
    """A photo of the video's name next to it stays as it is."""
    empty = write_video(tmp_path / "hand.avi", [{}] * 3)
    photo = tmp_path / "hand.jpg"
    photo.write_bytes(b"mine")
    with pytest.raises(NoHandSeen, match=r"a hand\. The"):
        track_video(empty, tmp_path / "hand.npz", networks=FakeNetworks())
    assert {path.name for path in tmp_path.iterdir()} == {"hand.avi", "hand.jpg"}
    assert photo.read_bytes() == b"mine"
    sheet = tmp_path / "sheet.jpg"
    with pytest.raises(NoHandSeen, match=r"sheet\.jpg has some"):
        track_video(empty, tmp_path / "hand.npz", networks=FakeNetworks(), unseen=sheet)
    assert sheet.stat().st_size > 1000


def test_a_video_that_ends_early_is_tracked_and_said(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """Half of a file: its frames are used, and both numbers stand in the result."""
    module = sys.modules["hwp_bench.tracking.track_video"]
    monkeypatch.setattr(module, "load_models", lambda model: None)
    monkeypatch.setattr(module, "LiteRtNetworks", lambda models: FakeNetworks())
    discs = [np.ascontiguousarray(picture({"left": (40 + k, 60)})) for k in range(24)]
    whole = write_pictures(tmp_path / "whole.mkv", discs, "ffv1", pix_fmt="bgr0")
    cut = tmp_path / "cut.mkv"
    cut.write_bytes(whole.read_bytes()[: whole.stat().st_size // 2])
    assert main(["data", "track", str(cut)]) == 0
    said = capsys.readouterr()
    assert "warning: " in said.err
    assert re.search(r"cut.mkv ends early, after 1[0-2] of 24 frames: the file is cut", said.err)
    assert re.search(r"cut.npz: 1[0-2] of 24 frames,", said.out)
    assert main(["data", "track", str(cut), "--json", "--overwrite"]) == 0
    facts = json.loads(capsys.readouterr().out)
    assert facts["reading"]["decoded_frames"] == facts["frames"] < 13
    assert (facts["reading"]["stated_frames"], facts["reading"]["ends_early"]) == (24, True)
    assert main(["data", "track", str(whole), "--json"]) == 0
    said = capsys.readouterr()
    assert "warning" not in said.err + said.out


def test_mistakes_are_one_line(
    video: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setenv("HWP_CACHE", str(tmp_path / "cache"))
    broken = tmp_path / "broken.avi"
    broken.write_bytes(b"RIFF")
    for arguments, status, message in (
        (["data", "track"], 2, "VIDEO is missing"),
        (["data", "track", str(tmp_path / "none.mp4")], 1, "does not exist"),
        (["data", "track", "."], 1, "is a folder where a file is expected"),
        (["data", "track", ""], 1, "is a folder where a file is expected"),
        (["data", "track", str(broken)], 1, "broken.avi"),
        (["data", "track", str(video), "-o", str(tmp_path / "x.txt")], 2, ".npz"),
        (["data", "track", str(video), "--model", str(broken)], 1, "not a readable archive"),
        (["data", "track", str(video), "--min-score", "2"], 2, "--min-score: is 2.0. Use"),
    ):
        assert main(arguments) == status, arguments
        said = capsys.readouterr().err
        assert message in said
        assert "Traceback" not in said
