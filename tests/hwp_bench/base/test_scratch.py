"""Temporary folders. Oracle: the file system, and processes that are really killed."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import tempfile
from pathlib import Path

import pytest

from hwp_bench.base.folders import UNLOCKED_SECONDS, remove_left, scratch_folder

HOLDER = """
import sys, time
from hwp_bench.base.folders import scratch_folder
with scratch_folder("hwp-test-") as folder:
    (folder / "frame.png").write_bytes(b"pixels")
    print(folder, flush=True)
    time.sleep(600)
"""


@pytest.fixture(autouse=True)
def temporary(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A temporary folder of the test's own, for child processes too."""
    monkeypatch.setenv("TMPDIR", str(tmp_path))
    monkeypatch.setattr(tempfile, "tempdir", None)
    return tmp_path


def _holder() -> tuple[subprocess.Popen[str], Path]:
    process = subprocess.Popen([sys.executable, "-c", HOLDER], stdout=subprocess.PIPE, text=True)
    assert process.stdout is not None
    return process, Path(process.stdout.readline().strip())


def test_the_folder_is_gone_in_the_end_whatever_ends_it(temporary: Path) -> None:
    with scratch_folder("hwp-test-") as folder:
        assert folder.parent == temporary
        assert folder.stat().st_mode & 0o77 == 0
    with pytest.raises(RuntimeError), scratch_folder("hwp-test-"):
        raise RuntimeError
    assert list(temporary.iterdir()) == []


@pytest.mark.skipif(sys.platform == "win32", reason="has no SIGKILL")
def test_the_next_start_removes_what_killed_processes_left_and_nothing_else(
    temporary: Path,
) -> None:
    killed, left = _holder()
    running, used = _holder()
    try:
        killed.send_signal(signal.SIGKILL)
        killed.wait()
        assert (left / "frame.png").is_file()
        other = temporary / "hwp-other-1"
        other.mkdir()
        with scratch_folder("hwp-test-") as folder:
            assert sorted(temporary.iterdir()) == sorted([folder, used, other])
        assert (used / "frame.png").is_file()
    finally:
        running.kill()
        running.wait()


def test_a_folder_without_a_lock_is_left_for_a_day(temporary: Path) -> None:
    young, old = temporary / "hwp-test-young", temporary / "hwp-test-old"
    for folder in (young, old):
        folder.mkdir()
    moment = old.stat().st_mtime - UNLOCKED_SECONDS - 60
    os.utime(old, (moment, moment))
    remove_left("hwp-test-")
    assert list(temporary.iterdir()) == [young]


def test_links_are_left_alone(temporary: Path) -> None:
    real = temporary / "real"
    (real / "kept").mkdir(parents=True)
    (real / ".lock").touch()
    (temporary / "hwp-test-link").symlink_to(real)
    remove_left("hwp-test-")
    assert (real / "kept").is_dir()
