"""Two runs on one output, and outputs that cannot be written. Oracle: the file system."""

from __future__ import annotations

import errno
import os
import shutil
import signal
import subprocess
import sys
import tempfile
from pathlib import Path

import pytest
from small_captures import CaptureMaker
from toy_method import write_toy_method

from hwp_bench.base.errors import HwpError
from hwp_bench.base.folders import (
    DEEPEST,
    UNLOCKED_SECONDS,
    exclusive,
    open_up,
    read_private,
    remove_left,
    remove_tree,
    scratch_folder,
    trim,
    write_private,
)
from hwp_bench.cli.main import main
from hwp_bench.results import read_results

ROOT = Path(__file__).parents[2]
HOLD = """
import sys, time
from hwp_bench.base.folders import exclusive
with exclusive(sys.argv[1]):
    print("held", flush=True)
    time.sleep(600)
"""


def _unwritable(tmp_path: Path) -> Path:
    """A folder that cannot be written, not even by root."""
    if os.geteuid() == 0:
        return Path("/sys/hwp-bench-test")
    folder = tmp_path / "sealed"
    folder.mkdir(mode=0o555)
    return folder / "out"


def test_the_second_is_told_and_a_killed_holder_lets_go(tmp_path: Path) -> None:
    out = tmp_path / "out"
    holder = subprocess.Popen(
        [sys.executable, "-c", HOLD, str(out)], cwd=ROOT, stdout=subprocess.PIPE
    )
    assert holder.stdout is not None
    assert holder.stdout.readline() == b"held\n"
    with pytest.raises(HwpError, match="another run is writing here"), exclusive(out):
        pass
    holder.kill()
    holder.wait()
    holder.stdout.close()
    with exclusive(out):
        pass


def test_whoever_waits_is_told_so_and_goes_on_when_the_holder_is_gone(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "capture"
    hold = HOLD.replace("sys.argv[1]", "sys.argv[1], wait=True").replace("600", "1")
    holder = subprocess.Popen(
        [sys.executable, "-c", hold, str(out)], cwd=ROOT, stdout=subprocess.PIPE
    )
    assert holder.stdout is not None
    assert holder.stdout.readline() == b"held\n"
    with exclusive(out, wait=True):
        assert holder.wait() == 0
    holder.stdout.close()
    assert "Waiting for another process that makes capture" in capsys.readouterr().err
    assert {item.name for item in tmp_path.iterdir()} == {".capture.lock"}
    with exclusive(out, wait=True):
        assert capsys.readouterr().err == ""


@pytest.mark.parametrize("code", [errno.EOPNOTSUPP, errno.ENOLCK])
def test_a_file_system_without_locks_does_not_fail(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, code: int
) -> None:
    def refuse(descriptor: int, operation: int) -> None:
        raise OSError(code, os.strerror(code))

    monkeypatch.setattr("fcntl.flock", refuse)
    for wait in (False, True):
        with exclusive(tmp_path / "out", wait=wait):
            pass


def test_two_runs_on_one_output_are_one_message_and_lose_nothing(
    make_capture: CaptureMaker, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    capture = make_capture("tiny", frames=20, size=32)
    method, out = write_toy_method(tmp_path / "toy"), tmp_path / "out"
    words = [str(method), "--capture", str(capture.root), "-o", str(out)]
    assert main(["evaluate", *words]) == 0
    before = (out / "results.json").read_bytes()
    with exclusive(out):
        for command in ("evaluate", "ablate"):
            capsys.readouterr()
            assert main([command, *words]) == 1
            said = capsys.readouterr().err.strip().splitlines()[-1]
            assert said.startswith(f"hwp-bench: error: {out}: another run is writing here.")
    assert (out / "results.json").read_bytes() == before
    assert not (out / "variants").exists()


@pytest.mark.parametrize("command", ["evaluate", "ablate"])
def test_a_place_that_cannot_be_written_is_one_message(
    make_capture: CaptureMaker,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    command: str,
) -> None:
    capture = make_capture("tiny", frames=20, size=32)
    out = _unwritable(tmp_path)
    method = write_toy_method(tmp_path / "toy")
    assert main([command, str(method), "--capture", str(capture.root), "-o", str(out)]) == 1
    said = capsys.readouterr().err.strip().splitlines()[-1]
    assert said.startswith(f"hwp-bench: error: {out}: cannot be written (")
    assert not out.exists()


def test_a_full_disc_is_one_message_and_the_next_start_finishes(
    make_capture: CaptureMaker,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    capture = make_capture("tiny", frames=20, size=32)
    method, out = write_toy_method(tmp_path / "toy"), tmp_path / "out"
    words = ["evaluate", str(method), "--capture", str(capture.root), "-o", str(out)]

    def full(source: str, target: str) -> None:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC), str(target))

    with monkeypatch.context() as patched:
        # What a disc that is full says when the predictions are put by.
        patched.setattr(
            shutil, "copyfile", lambda a, b, **_: full(a, b) if "000018" in str(b) else None
        )
        assert main(words) == 1
    said = capsys.readouterr().err.strip().splitlines()[-1]
    assert said.startswith("hwp-bench: error: ")
    assert f"{out}/captures/.unfinished/tiny: cannot be written (No space left on device)" in said
    assert said.endswith("what is finished stays.")
    assert not (out / "results.json").exists()
    assert main(words) == 0
    assert read_results(out).captures[0].failed_frames == 0


def test_two_fits_of_one_avatar_are_one_message(make_capture: CaptureMaker, tmp_path: Path) -> None:
    from hwp_bench.methods.contract import Budget
    from wildghand.fitting.session import fit_capture

    out = tmp_path / "avatar"
    with (
        exclusive(tmp_path / "avatar.fit"),
        pytest.raises(HwpError, match="another run is writing here"),
    ):
        fit_capture(make_capture("tiny").root, out, settings={}, budget=Budget(steps=1))
    assert not out.exists()
    assert not (tmp_path / "avatar.fit" / "request").exists()


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


# Of two characters each: longer than the 4,096 of a path.
LEVELS = 2100


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


def test_a_deep_folder_does_not_stay_in_a_scratch_folder() -> None:
    with scratch_folder("hwp-deep-") as folder:
        nested(folder)
    assert not folder.exists()


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
