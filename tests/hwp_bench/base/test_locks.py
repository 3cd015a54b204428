"""Two runs on one output, and outputs that cannot be written. Oracle: the file system."""

from __future__ import annotations

import errno
import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest
from small_captures import CaptureMaker
from toy_method import write_toy_method

from hwp_bench.base.errors import HwpError
from hwp_bench.base.folders import exclusive
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
    assert {item.name for item in tmp_path.iterdir()} == {"capture.lock"}
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
