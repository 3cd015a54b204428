"""Cache folders: what was used longest ago goes first; private files are this user's alone."""

from __future__ import annotations

import os
from pathlib import Path

import pytest

from hwp_bench.base.folders import read_private, trim, write_private


def test_what_was_used_longest_ago_goes_first(tmp_path: Path) -> None:
    for age, name in enumerate(("new.x", "middle.x", "old.x", "other.y")):
        (tmp_path / name).write_bytes(bytes(10))
        os.utime(tmp_path / name, (1000 - age, 1000 - age))
    trim(tmp_path, ".x", 20)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["middle.x", "new.x", "other.y"]
    trim(tmp_path / "absent", ".x", 0)


def test_what_is_written_is_read_and_is_for_this_user_alone(tmp_path: Path) -> None:
    path = tmp_path / "cache" / "kernels" / "a"
    assert read_private(path, 10) is None
    assert write_private(path, b"data")
    assert read_private(path, 10) == b"data"
    assert path.stat().st_mode & 0o777 == 0o600
    assert path.parent.stat().st_mode & 0o777 == 0o700
    assert read_private(path, 3) is None


def test_a_file_or_folder_that_others_may_write_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "kernels" / "a"
    write_private(path, b"data")
    path.chmod(0o622)
    assert read_private(path, 10) is None
    path.chmod(0o600)
    path.parent.chmod(0o777)
    assert read_private(path, 10) is None
    assert not write_private(path, b"new")
    path.parent.chmod(0o700)
    assert read_private(path, 10) == b"data"


def test_what_belongs_to_somebody_else_is_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / "kernels" / "a"
    write_private(path, b"data")
    somebody_else = os.geteuid() + 1
    monkeypatch.setattr(os, "geteuid", lambda: somebody_else)
    assert read_private(path, 10) is None
    assert not write_private(path, b"new")


def test_a_link_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "kernels" / "a"
    write_private(path, b"data")
    (path.parent / "link").symlink_to(path)
    assert read_private(path.parent / "link", 10) is None
    (tmp_path / "folder").symlink_to(path.parent)
    assert read_private(tmp_path / "folder" / "a", 10) is None


def test_a_place_that_cannot_be_written_raises_nothing(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    assert not write_private(tmp_path / "file" / "kernels" / "a", b"data")
