"""MediaPipe's networks and their files.

Oracles: landmarks that MediaPipe itself found in a real video; archives made here, and hashlib.

Needs the networks in the cache (`hwp-bench data track --fetch` puts them there; `.ci/run` tries to)
and, for the comparison, the real video in `../shared/data`.
"""

from __future__ import annotations

import hashlib
import io
import sys
import urllib.error
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import IO

import numpy as np
import pytest

from hwp_bench.base.download import Pinned
from hwp_bench.base.errors import BadInput, HwpError, MissingDependency
from hwp_bench.importers.video.decode import FrameRange, probe, read_frames
from hwp_bench.tracking import networks as model_files
from hwp_bench.tracking.networks import (
    HAND,
    PALM,
    TASK_MEMBERS,
    HandModels,
    LiteRtNetworks,
    fetch_models,
    load_models,
    models_folder,
    read_members,
)
from hwp_bench.tracking.track_video import TrackerSettings, track_frames

CLIP = Path(__file__).resolve().parents[4] / "shared" / "data" / "real_hand"


@pytest.fixture(scope="module")
def networks() -> LiteRtNetworks:
    if not all((models_folder() / name).is_file() for name in (PALM, HAND)):
        pytest.skip("the networks are not in the cache: hwp-bench data track --fetch")
    return LiteRtNetworks(load_models())


def test_an_empty_picture_shows_no_hand(networks: LiteRtNetworks) -> None:
    grey = np.full((96, 128, 3), 128, np.uint8)
    assert track_frames([grey, grey], networks, TrackerSettings()).hands((128, 96), 2) is None


def test_landmarks_are_those_of_mediapipe(networks: LiteRtNetworks) -> None:
    video = CLIP / "human_hand_video.mp4"
    if not video.is_file():
        pytest.skip("the real video is not here")
    count = 8
    frames = (frame for _, frame in read_frames(probe(video), FrameRange(stop=count)))
    hands = track_frames(frames, networks, TrackerSettings()).hands((1280, 720), 2)
    assert hands is not None
    with np.load(CLIP / "landmarks.npz") as expected:
        apart = hands.image[0, :, :, :2] - expected["image"][:count, :, :2]
        assert np.median(np.linalg.norm(apart, axis=2)) < 1.0
        depth = hands.image[0, :, :, 2] - expected["image"][:count, :, 2]
        assert np.median(np.abs(depth)) < 1.0
        apart = hands.world[0] - expected["world"][:count]
        assert np.median(np.linalg.norm(apart, axis=2)) < 1e-3
        # The tool wrote how sure the network is of the side, which was right in every frame.
        np.testing.assert_allclose(hands.right[0], expected["score"][:count], atol=0.01)
    assert hands.side(0) == "right"


def test_other_networks_are_refused(networks: LiteRtNetworks) -> None:
    models = load_models()
    with pytest.raises(BadInput, match="Only MediaPipe's networks"):
        LiteRtNetworks(HandModels(models.hand, models.palm, "swapped"))
    with pytest.raises(BadInput, match="cannot be loaded"):
        LiteRtNetworks(HandModels(models.palm[:5000], models.hand, "truncated"))


def test_without_the_runtime_it_says_what_to_install(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "ai_edge_litert.interpreter", None)
    with pytest.raises(MissingDependency, match=r"pip install 'hwp-bench\[track\]'"):
        LiteRtNetworks(HandModels(b"", b"", "nothing"))


CONTENTS = {
    PALM: b"\0\0\0\0TFL3 palm",
    HAND: b"\0\0\0\0TFL3 hand, which is longer",
    "LICENSE": b"Apache License, Version 2.0",
}


def pinned(name: str, content: bytes) -> Pinned:
    return Pinned(name, len(content), hashlib.sha256(content).hexdigest())


def archive(*members: tuple[str, bytes]) -> bytes:
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w", zipfile.ZIP_DEFLATED) as opened:
        for name, content in members:
            opened.writestr(name, content)
    return buffer.getvalue()


@pytest.fixture
def wheel(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> bytes:
    """A small wheel, pinned in place of the real one; the cache is empty."""
    monkeypatch.setenv("HWP_CACHE", str(tmp_path / "cache"))
    names = {name: f"mediapipe/{name}" for name in CONTENTS}
    members = {name: pinned(names[name], content) for name, content in CONTENTS.items()}
    monkeypatch.setattr(model_files, "MEMBERS", members)
    return archive(
        ("mediapipe/__init__.py", b"raise SystemExit"),
        ("../../escaped.txt", b"out of the folder"),
        *((names[name], content) for name, content in CONTENTS.items()),
    )


def serve(content: bytes) -> Callable[[str], IO[bytes]]:
    return lambda address: io.BytesIO(content)


def files_below(folder: Path) -> list[str]:
    return sorted(path.name for path in folder.rglob("*") if path.is_file())


def test_the_networks_and_the_licence_are_kept_and_nothing_else(
    wheel: bytes, tmp_path: Path
) -> None:
    folder = fetch_models(opener=serve(wheel), wheel=pinned("https://wheel", wheel))
    assert folder == models_folder()
    assert files_below(tmp_path) == sorted(CONTENTS)
    models = load_models()
    assert (models.palm, models.hand) == (CONTENTS[PALM], CONTENTS[HAND])


def test_a_wheel_with_another_hash_is_refused_and_nothing_is_kept(
    wheel: bytes, tmp_path: Path
) -> None:
    changed = wheel[:-1] + bytes([wheel[-1] ^ 1])
    with pytest.raises(BadInput, match="do not trust it"):
        fetch_models(opener=serve(changed), wheel=pinned("https://wheel", wheel))
    with pytest.raises(BadInput, match=r"has \d+ bytes and SHA-256"):
        fetch_models(opener=serve(wheel * 3), wheel=pinned("https://wheel", wheel))
    assert files_below(tmp_path) == []


def test_an_endless_download_ends(wheel: bytes) -> None:
    class Endless(io.RawIOBase):
        given = 0

        def read(self, size: int = -1) -> bytes:
            self.given += size
            return bytes(size)

    stream = Endless()
    with pytest.raises(BadInput, match="do not trust it"):
        fetch_models(
            opener=lambda address: stream,  # type: ignore[arg-type, return-value]
            wheel=pinned("https://wheel", wheel),
        )
    assert stream.given <= 2 << 20


def test_a_member_with_another_hash_is_refused(wheel: bytes, tmp_path: Path) -> None:
    other = archive(*((f"mediapipe/{name}", content + b"!") for name, content in CONTENTS.items()))
    with pytest.raises(BadInput, match=r"where \w+ is expected"):
        fetch_models(opener=serve(other), wheel=pinned("https://wheel", other))
    assert files_below(tmp_path) == []


def test_a_changed_file_in_the_cache_is_refused(wheel: bytes) -> None:
    folder = fetch_models(opener=serve(wheel), wheel=pinned("https://wheel", wheel))
    (folder / HAND).write_bytes(CONTENTS[HAND].replace(b"hand", b"HAND"))
    with pytest.raises(BadInput, match="Delete it and run the command again"):
        load_models()


def test_without_network_and_cache_one_message_says_what_helps(wheel: bytes) -> None:
    def unreachable(address: str) -> IO[bytes]:
        raise urllib.error.URLError("Temporary failure in name resolution")

    with pytest.raises(HwpError) as caught:
        load_models(opener=unreachable)
    message = str(caught.value)
    for part in ("name resolution", "--fetch", "--model", "pip download", str(models_folder())):
        assert part in message
    assert "\n" not in message


@pytest.mark.parametrize("kind", ["task", "whl", "folder"])
def test_networks_from_a_file_of_the_user(wheel: bytes, tmp_path: Path, kind: str) -> None:
    if kind == "folder":
        path = tmp_path / "models"
        path.mkdir()
        for name in (PALM, HAND):
            (path / name).write_bytes(CONTENTS[name])
    elif kind == "whl":
        path = tmp_path / "mediapipe.whl"
        path.write_bytes(wheel)
    else:
        path = tmp_path / "hand_landmarker.task"
        path.write_bytes(archive(*zip(TASK_MEMBERS, (CONTENTS[PALM], CONTENTS[HAND]), strict=True)))
    models = load_models(path)
    assert (models.palm, models.hand) == (CONTENTS[PALM], CONTENTS[HAND])


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (b"not a zip", "is not a readable archive"),
        (archive((TASK_MEMBERS[0], b"x")), "contains hand_landmarks_detector.tflite 0 times"),
        (archive(*((name, b"12345678") for name in TASK_MEMBERS)), "TensorFlow Lite"),
        (archive(*(((f"../{name}"), b"1") for name in TASK_MEMBERS)), "0 times"),
    ],
)
def test_files_that_are_no_model(tmp_path: Path, content: bytes, message: str) -> None:
    path = tmp_path / "model.task"
    path.write_bytes(content)
    with pytest.raises(BadInput, match=message):
        load_models(path)
    with pytest.raises(BadInput):
        load_models(tmp_path / "missing.task")
    with pytest.raises(BadInput, match="must contain"):
        load_models(tmp_path)


@pytest.mark.filterwarnings("ignore:Duplicate name")
def test_doubles_and_giants_are_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    double = io.BytesIO(archive(("a", b"1"), ("a", b"2")))
    with pytest.raises(BadInput, match="2 times"):
        read_members(double, ["a"], where="double.zip")
    monkeypatch.setattr(model_files, "MAX_NETWORK", 1000)
    giant = archive(("a", bytes(100_000)))
    with pytest.raises(BadInput, match="100000 bytes"):
        read_members(io.BytesIO(giant), ["a"], where="giant.zip")
    # One that states a small size and unpacks to a large one.
    stated = (100_000).to_bytes(4, "little")
    liar = giant.replace(stated, (10).to_bytes(4, "little"))
    assert liar != giant
    with pytest.raises(BadInput):
        read_members(io.BytesIO(liar), ["a"], where="liar.zip")
