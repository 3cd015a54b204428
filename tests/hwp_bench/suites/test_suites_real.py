"""Suites of real clips. Oracles: files in a folder and on a local server, hashlib, the split rule.

The clips are synthetic videos, a manifest pins them, and the synthetic clip's own landmarks stand
in for the tracker's.
"""

from __future__ import annotations

import errno
import functools
import hashlib
import http.server
import io
import json
import os
import re
import threading
import urllib.request
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import IO, Any

import pytest
from made_entries import complete_results, with_keys
from small_methods import write_submission
from synthetic_clip import landmark_import, make_clip, write_landmarks, write_video

from hwp_bench.base.errors import BadInput, BadResult, HwpError
from hwp_bench.capture import open_capture
from hwp_bench.capture.splits import split_for
from hwp_bench.cli.main import main
from hwp_bench.importers.video import VideoImport
from hwp_bench.leaderboard.board import board_tables
from hwp_bench.leaderboard.entries import make_entry
from hwp_bench.leaderboard.rules import check_bound, check_complete, check_entries, off_the_data
from hwp_bench.report.requested_table import TableRequest, make_table
from hwp_bench.results import Results, read_results
from hwp_bench.suites import real
from hwp_bench.suites.real import ensure_clips, read_clips
from hwp_bench.suites.suite import ensure_suite, find_missing, is_ready
from hwp_bench.taxonomy import SIZED_LIKE

COUNT = 20
ADDRESS = "https://raw.githubusercontent.com/"
ENTRY = """
[[clips]]
id = "{id}"
repository = "someone/hands"
commit = "{commit}"
path = "videos of hands/{id}.avi"
bytes = {bytes}
sha256 = "{sha256}"
licence = "MIT"
shows = "a hand"
hands = "right"
stride = 2
size = 64
frame_count = 10
"""


@pytest.fixture(autouse=True)
def own_manifest(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """Every test has a cache of its own; the manifest that ships is read again afterwards."""
    monkeypatch.setenv("HWP_CACHE", str(tmp_path / "cache"))
    read_clips.cache_clear()
    yield
    read_clips.cache_clear()


@pytest.fixture(scope="module")
def videos(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Two videos under names that say nothing, and one of the same size that is neither."""
    folder = tmp_path_factory.mktemp("videos")
    for name, shift in (("a", 0.0), ("b", 0.01)):
        clip = make_clip(COUNT, shift=[shift, 0.0, 0.0])  # type: ignore[arg-type]
        write_video(folder / f"{name}.avi", [clip.picture(frame) for frame in range(COUNT)])
        write_landmarks(folder / f"{name}.npz", clip.landmarks)
    changed = bytearray((folder / "a.avi").read_bytes())
    changed[-1] ^= 1
    (folder / "0.avi").write_bytes(bytes(changed))
    return folder


@pytest.fixture
def tracked(videos: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """`real-1` is two clips, `first` and `second`; returns which videos were tracked."""
    text, landmarks = 'schema = "hwp-clips/1"\n', {}
    for identifier, name in (("first", "a"), ("second", "b")):
        content = (videos / f"{name}.avi").read_bytes()
        digest = hashlib.sha256(content).hexdigest()
        landmarks[digest] = (videos / f"{name}.npz").read_bytes()
        fields = {"id": identifier, "bytes": len(content), "sha256": digest}
        text += ENTRY.format(commit="c0ffee" + "0" * 34, **fields)
    (tmp_path / "real-1.toml").write_text(text, encoding="utf-8")
    monkeypatch.setattr(real, "MANIFESTS", tmp_path)
    told: list[str] = []

    def track(video: Path, out: Path, **_: Any) -> None:
        told.append(hashlib.sha256(video.read_bytes()).hexdigest())
        out.write_bytes(landmarks[told[-1]])

    monkeypatch.setattr("hwp_bench.tracking.track_video", track)
    few = functools.partial(VideoImport, fit=landmark_import(20, outline_steps=2))
    monkeypatch.setattr("hwp_bench.importers.video.VideoImport", few)
    return told


def flat(text: str) -> str:
    """A text without its line breaks."""
    return " ".join(text.split())


def only(folder: Path, videos: Path, *names: str) -> Path:
    """A new folder with some of the videos."""
    folder.mkdir()
    for name in names:
        (folder / name).write_bytes((videos / name).read_bytes())
    return folder


def test_the_manifest_that_ships_is_whole() -> None:
    clips = read_clips("real-1")
    assert [clip.id for clip in clips] == [
        "coderenko_hand",
        "kusanagi_hand",
        "mediapipe_hand_landmarker_test",
    ]
    for clip in clips:
        assert re.fullmatch(rf"{ADDRESS}[\w.-]+/[\w.-]+/[0-9a-f]{{40}}/[\w./-]+", clip.file.name)
        assert clip.licence in ("MIT", "Apache-2.0")
        split, tenth = split_for(clip.id, clip.frame_count), clip.frame_count // 10
        frames = list(range(clip.frame_count))
        assert split.test.tolist() == frames[-len(split.test) :]
        assert split.validation.tolist() == frames[: -len(split.test)][-len(split.validation) :]
        assert {len(split.test), len(split.validation)} <= {tenth, tenth + 1}
    assert SIZED_LIKE["real-1"] == "mini"


@pytest.mark.parametrize(
    ("field", "value"),
    [
        ("sha256", '"00"'),
        ("commit", '"main"'),
        ("repository", '"../../etc"'),
        ("id", '"a/b"'),
        ("bytes", "0"),
        ("hands", '"three"'),
    ],
)
def test_a_wrong_entry_of_the_manifest_is_refused(
    tracked: list[str], tmp_path: Path, field: str, value: str
) -> None:
    path = tmp_path / "real-1.toml"
    text = re.sub(rf"(?m)^{field} = .*$", f"{field} = {value}", path.read_text(), count=1)
    path.write_text(text)
    with pytest.raises(BadInput, match=field):
        read_clips("real-1")


def test_clips_of_a_folder_are_found_by_their_content_and_imported_once(
    tracked: list[str], videos: Path
) -> None:
    assert not is_ready("real-1")
    folders, missing = ensure_clips("real-1", videos)
    assert (len(folders), missing) == (2, {})
    assert tracked == [clip.sha256 for clip in read_clips("real-1")]
    for folder, clip in zip(folders, read_clips("real-1"), strict=True):
        info = open_capture(folder).info
        assert (info.id, info.frame_count, info.width, info.hands) == (clip.id, 10, 64, "right")
        assert info.source["video"]["sha256"] == clip.sha256
        assert info.source["frames"] == list(range(0, COUNT, 2))
        assert info.licence.startswith("MIT")
        assert clip.is_source_of(info)
        assert not clip.is_source_of(replace(info, source={**info.source, "frames": [0]}))
    # Nothing is asked for again: neither a folder, nor the network, nor the tracker.
    assert is_ready("real-1")
    assert ensure_suite("real-1") == folders
    assert len(tracked) == 2
    # Where the importer has another version, the video is there, and is imported again.
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("hwp_bench.importers.video.api.MADE_BY", "video 0")
        assert not is_ready("real-1")


def test_a_clip_of_other_frames_than_the_manifest_says_is_an_error(
    tracked: list[str], videos: Path, tmp_path: Path
) -> None:
    path = tmp_path / "real-1.toml"
    path.write_text(path.read_text().replace("frame_count = 10", "frame_count = 11"))
    with pytest.raises(BadInput, match="has 10 frames where the manifest says 11"):
        ensure_clips("real-1", videos)


@pytest.fixture
def server(
    videos: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> Iterator[dict[str, bytes]]:
    """A web server on this machine in place of GitHub; what it has by address can be changed."""
    commit = "someone/hands/c0ffee" + "0" * 34
    content = {
        f"/{commit}/videos%20of%20hands/{identifier}.avi": (videos / f"{name}.avi").read_bytes()
        for identifier, name in (("first", "a"), ("second", "b"))
    }

    class Handler(http.server.BaseHTTPRequestHandler):
        def do_GET(self) -> None:
            self.send_response(200 if self.path in content else 404)
            self.end_headers()
            self.wfile.write(content.get(self.path, b""))

        def log_message(self, *_: Any) -> None:
            pass

    with http.server.ThreadingHTTPServer(("127.0.0.1", 0), Handler) as served:
        threading.Thread(target=served.serve_forever, daemon=True).start()

        def open_here(address: str) -> IO[bytes]:
            here = f"http://127.0.0.1:{served.server_port}/"
            opened: IO[bytes] = urllib.request.urlopen(address.replace(ADDRESS, here), timeout=60)
            return opened

        monkeypatch.setattr("hwp_bench.base.download.open_address", open_here)
        yield content
        served.shutdown()


def test_what_the_network_does_not_give_is_left_out_by_name(
    tracked: list[str], server: dict[str, bytes], tmp_path: Path, capsys
) -> None:
    first, second = list(server)
    there, server[second] = server.pop(first), server[second][:-1] + b"!"
    with pytest.raises(HwpError, match="no clip of real-1 is available"):
        ensure_suite("real-1")
    told = capsys.readouterr().err
    assert "real-1 without first" in told
    assert "404" in told
    assert "real-1 without second" in told
    assert "do not trust it" in told
    assert [path for path in (tmp_path / "cache").rglob("*") if path.is_file()] == []
    server[first] = there
    assert main(["data", "get", "real-1"]) == 1
    shown = capsys.readouterr().out
    assert re.search(r"capture: .*/first-", shown)
    assert "missing: second" in shown
    # The other one from a folder; what is there stays.
    folder = tmp_path / "mine"
    folder.mkdir()
    (folder / "whatever").write_bytes(server[second])
    assert main(["data", "get", "real-1", "--from", str(folder), "--json"]) == 1
    found = json.loads(capsys.readouterr().out)
    assert list(found["missing"]) == ["second"]
    assert "holds no file of second" in found["missing"]["second"]
    assert len(tracked) == 1


def test_a_result_over_fewer_clips_says_so_and_is_not_ranked_with_a_whole_one(
    tracked: list[str], videos: Path, tmp_path: Path, capsys
) -> None:
    few = only(tmp_path / "few", videos, "a.avi")
    assert main(["data", "get", "real-1", "--from", str(few)]) == 1
    (capture,) = (open_capture(path) for path in ensure_clips("real-1", few)[0])
    drawn = {f"first/{frame:06d}.png": capture.frame(frame) for frame in (9,)}
    drawn["second/000009.png"] = capture.frame(9)
    entry = write_submission(tmp_path / "entry", drawn)
    words = ["evaluate", str(entry), "--suite", "real-1", "-o"]

    def offline(address: str) -> IO[bytes]:
        raise OSError("network is unreachable")

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("hwp_bench.base.download.open_address", offline)
        assert main([*words, str(tmp_path / "part")]) == 0
    told = capsys.readouterr()
    assert "real-1 without second" in told.err
    assert "warning: real-1 lacks 1 of 2 captures: second" in told.err
    assert "real-1: 1 captures, 1 test frames, lacks 1 of 2 captures: second" in flat(told.out)
    part = read_results(tmp_path / "part")
    assert find_missing(part) == ["lacks 1 of 2 captures: second"]
    assert part.captures[0].origin == read_clips("real-1")[0].origin
    assert main(["data", "get", "real-1", "--from", str(videos)]) == 0
    assert main([*words, str(tmp_path / "whole")]) == 0
    table = make_table(TableRequest([tmp_path / "part", tmp_path / "whole"]))
    notes = " ".join(table.notes)
    assert "only rows of the same data are ranked together" in notes
    assert "real-1, 1 capture, 1 test frames; lacks 1 of 2 captures: second" in notes
    # A check of all that a result says holds for both.
    for name, status in (("whole", 0), ("part", 1)):
        assert main(["verify", str(tmp_path / name)]) == status
    assert "lacks 1 of 2 captures: second" in flat(capsys.readouterr().out)


def results(name: str, score: float, machine: str = "e", **changes: object) -> Results:
    """Results on `real-1` as a machine imports it, whose captures have its digests."""
    made = complete_results(name, score, suite_name="real-1")
    captures = [replace(c, digest=machine * 64, **changes) for c in made.captures]
    return with_keys(replace(made, captures=captures))


def test_the_board_knows_a_clip_by_what_it_is_imported_from() -> None:
    one = make_entry(results("mine", 20.0))
    other = make_entry(results("yours", 21.0, machine="f"))
    assert off_the_data([one, other]) == []
    for entry in check_entries([one, other]):
        check_bound(entry)
        check_complete(entry)
    (table,) = board_tables([one, other])
    assert "real-1" in table.caption
    assert [row[0] for row in table.rows] == ["Yours", "Mine"]
    for origin in (None, "0" * 64):
        foreign = make_entry(results("theirs", 30.0, origin=origin))
        with pytest.raises(BadResult, match="is not what this version imports"):
            check_bound(foreign)
    lacking = results("less", 30.0)
    lacking = make_entry(replace(lacking, captures=lacking.captures[1:]))
    with pytest.raises(BadResult, match="lacks 1 of 3 captures: coderenko_hand"):
        check_complete(lacking)
    assert not off_the_data([lacking, one])
    (table,) = board_tables([one, lacking])
    assert [row[0] for row in table.rows] == ["Mine", "Less"]
    assert table.unranked == {1}
    # A suite apart, beside the simulated ones.
    both = board_tables([one, make_entry(complete_results("mine"))])
    assert [re.findall("real-1|smoke", table.caption) for table in both] == [["smoke"], ["real-1"]]


def test_a_full_disc_is_not_taken_for_a_missing_clip(
    tracked: list[str], videos: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    class Full(io.BytesIO):
        def write(self, data: Any) -> int:
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    honest = real.download

    def download(file: Any, target: Any, opener: Any = None) -> None:
        honest(file, Full(), opener)

    monkeypatch.setattr(real, "download", download)
    with pytest.raises(HwpError, match=r"cannot be written \(No space left"):
        ensure_clips("real-1", videos)
