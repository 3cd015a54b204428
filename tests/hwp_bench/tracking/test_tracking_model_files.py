"""The networks' files. Oracle: archives made here, whole or broken in one way."""

from __future__ import annotations

import hashlib
import io
import urllib.error
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import IO

import pytest

from hwp_bench.base.errors import BadInput, HwpError
from hwp_bench.tracking import networks as model_files
from hwp_bench.tracking.networks import (
    HAND,
    PALM,
    TASK_MEMBERS,
    Pinned,
    fetch_models,
    load_models,
    models_folder,
    read_members,
)

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
