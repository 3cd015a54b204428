"""Working folders of runs. Oracle: the file system after a process was killed."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import tempfile
from pathlib import Path

import pytest

from hwp_bench.run.scratch import remove_abandoned, scratch_folder

HOLD = """
import sys
from hwp_bench.run.scratch import scratch_folder
with scratch_folder("hwp-test-") as folder:
    (folder / "frame.png").write_text("a training frame")
    print(folder, flush=True)
    sys.stdin.read()
"""


@pytest.fixture
def temporary(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))
    monkeypatch.setenv("TMPDIR", str(tmp_path))
    return tmp_path


def age(folder: Path) -> None:
    os.utime(folder, (0, 0))


def test_a_killed_run_leaves_nothing_for_ever(temporary: Path) -> None:
    command = [sys.executable, "-c", HOLD]
    pipe = subprocess.PIPE
    with subprocess.Popen(command, text=True, stdin=pipe, stdout=pipe) as holder:
        assert holder.stdout is not None
        folder = Path(holder.stdout.readline().strip())
        assert folder.parent == temporary
        age(folder)
        # Who holds it keeps it, whatever its age.
        assert remove_abandoned("hwp-test-") == 0
        assert (folder / "frame.png").is_file()
        holder.send_signal(signal.SIGKILL)
    assert folder.is_dir()
    age(folder)
    with scratch_folder("hwp-test-") as new:
        assert new != folder
        assert not folder.exists()
    assert list(temporary.iterdir()) == []


def test_what_is_young_or_of_something_else_stays(temporary: Path) -> None:
    young, other, link = (temporary / f"hwp-test-{name}" for name in ("young", "other", "link"))
    young.mkdir()
    (young / ".held").touch()
    other.mkdir()
    age(other)
    link.symlink_to(other)
    assert remove_abandoned("hwp-test-") == 0
    assert {path.name for path in temporary.iterdir()} == {young.name, other.name, link.name}
