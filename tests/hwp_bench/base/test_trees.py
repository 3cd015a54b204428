"""Folders that untrusted programs have filled. Oracle: the file system."""

from __future__ import annotations

import os
from pathlib import Path

import pytest

from hwp_bench.base.folders import DEEPEST, open_up, remove_tree

LEVELS = 3000


def nested(folder: Path, levels: int = LEVELS) -> None:
    """Make folders in folders, deeper than any path may be long and than Python may call."""
    here = os.open(folder, os.O_RDONLY)
    try:
        for _ in range(levels):
            os.mkdir("d", dir_fd=here)
            inner = os.open("d", os.O_RDONLY, dir_fd=here)
            os.close(here)
            here = inner
        os.close(os.open("frame.png", os.O_CREAT | os.O_WRONLY, dir_fd=here))
    finally:
        os.close(here)


def test_a_thousand_levels_are_removed(tmp_path: Path) -> None:
    folder = tmp_path / "output"
    folder.mkdir()
    nested(folder)
    remove_tree(folder)
    assert not folder.exists()
    remove_tree(folder)


def test_what_is_closed_is_opened_and_what_is_odd_goes(tmp_path: Path) -> None:
    folder = tmp_path / "output"
    (folder / "predictions").mkdir(parents=True)
    frame = folder / "predictions" / "000001.png"
    frame.write_bytes(b"a frame")
    (folder / "link.png").symlink_to(frame)
    os.mkfifo(folder / "predictions" / "000002.png")
    nested(folder)
    frame.chmod(0)
    (folder / "predictions").chmod(0)
    open_up(folder)
    assert [path.name for path in (folder / "predictions").iterdir()] == ["000001.png"]
    assert frame.read_bytes() == b"a frame"
    assert frame.stat().st_mode & 0o600 == 0o600
    assert not os.path.lexists(folder / "link.png")
    deepest = folder.joinpath(*["d"] * DEEPEST)
    assert deepest.is_dir()
    assert list(deepest.iterdir()) == []


@pytest.mark.parametrize("mode", [0o000, 0o300])
def test_a_closed_folder_does_not_stay(tmp_path: Path, mode: int) -> None:
    folder = tmp_path / "output"
    (folder / "inner").mkdir(parents=True)
    (folder / "inner" / "frame.png").touch()
    (folder / "inner").chmod(mode)
    remove_tree(folder)
    assert not folder.exists()
