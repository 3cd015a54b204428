"""Machine code on disk: found again where nothing changed, made again where something did.

Oracle: small installations of the toolkit, whose kernels are called in processes of their own;
numba's own count of what was found on disk.
"""

from __future__ import annotations

import hashlib
import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from hwp_bench.base.packages import PACKAGES

_KERNELS = """
from hwp_bench.base.kernels import compiled
from hwp_bench.room.constants import FACTOR

@compiled(nogil=True)
def outer(x):
    return inner(x) + 1

@compiled()
def inner(x):
    return x * FACTOR
"""
_PROGRAM = """
from hwp_bench.room.kernels import outer
value = outer(2)
stats = outer.stats
print(value, "found" if sum(stats.cache_hits.values()) else "compiled")
"""


class Installation:
    """The part of the toolkit that compiles, and a room with kernels."""

    def __init__(self, folder: Path, cache: Path) -> None:
        self.folder = folder
        self.cache = cache
        shutil.copytree(PACKAGES / "hwp_bench" / "base", folder / "hwp_bench" / "base")
        self.room = folder / "hwp_bench" / "room"
        self.room.mkdir()
        (folder / "hwp_bench" / "__init__.py").write_text("")
        (self.room / "__init__.py").write_text("")
        (self.room / "constants.py").write_text("FACTOR = 10")
        (self.room / "kernels.py").write_text(_KERNELS)

    def call(self, **environment: str) -> str:
        """What the kernel returns for 2, and whether its machine code was found."""
        done = subprocess.run(
            [sys.executable, "-c", _PROGRAM],
            env={
                **os.environ,
                "PYTHONPATH": str(self.folder),
                "HWP_CACHE": str(self.cache),
                **environment,
            },
            cwd=self.folder,
            capture_output=True,
            text=True,
            check=True,
        )
        return done.stdout.strip()

    def code(self) -> Path:
        """The one file of the outer kernel."""
        (path,) = self.cache.glob("kernels/*outer*.code")
        return path


@pytest.fixture(scope="module")
def compiled_once(tmp_path_factory: pytest.TempPathFactory) -> Path:
    cache = tmp_path_factory.mktemp("compiled") / "cache"
    assert Installation(cache.parent / "one", cache).call() == "21 compiled"
    return cache


@pytest.fixture
def installation(compiled_once: Path, tmp_path: Path) -> Installation:
    """An installation whose kernels another one has compiled."""
    shutil.copytree(compiled_once, tmp_path / "cache")
    return Installation(tmp_path / "one", tmp_path / "cache")


def test_another_installation_finds_it(installation: Installation) -> None:
    assert installation.call() == "21 found"


def test_a_constant_of_another_module_compiles_again(installation: Installation) -> None:
    (installation.room / "constants.py").write_text("FACTOR = 20")
    assert installation.call() == "41 compiled"
    # The former text finds the former code: versions do not drive each other out.
    (installation.room / "constants.py").write_text("FACTOR = 10")
    assert installation.call() == "21 found"


def test_a_changed_kernel_that_is_called_compiles_again(installation: Installation) -> None:
    (installation.room / "kernels.py").write_text(_KERNELS.replace("x * F", "3 + x * F"))
    assert installation.call() == "24 compiled"


def test_other_settings_of_numba_compile_again(installation: Installation) -> None:
    assert installation.call(NUMBA_OPT="1") == "21 compiled"


def test_damaged_code_compiles_again(installation: Installation) -> None:
    path = installation.code()
    raw = path.read_bytes()
    half = len(raw) // 2
    (inner,) = installation.cache.glob("kernels/*inner*.code")
    # The last is whole, but of another function.
    flipped = raw[:half] + bytes([raw[half] ^ 1]) + raw[half + 1 :]
    for damaged in (raw[:half], flipped, b"", inner.read_bytes()):
        path.write_bytes(damaged)
        assert installation.call() == "21 compiled"
        assert path.read_bytes()[:32] == hashlib.sha256(path.read_bytes()[32:]).digest()
    assert installation.call() == "21 found"


def test_code_that_others_may_have_written_is_not_loaded(installation: Installation) -> None:
    installation.code().chmod(0o666)
    assert installation.call() == "21 compiled"
    installation.code().parent.chmod(0o777)
    assert installation.call() == "21 compiled"


def test_a_second_folder_is_read_and_not_written(
    installation: Installation, tmp_path: Path
) -> None:
    shared = {"HWP_KERNELS": str(installation.cache / "kernels")}
    other = Installation(tmp_path / "two", tmp_path / "own")
    assert other.call(**shared) == "21 found"
    assert not (tmp_path / "own").exists()
    (other.room / "constants.py").write_text("FACTOR = 20")
    before = sorted((installation.cache / "kernels").iterdir())
    assert other.call(**shared) == "41 compiled"
    assert sorted((installation.cache / "kernels").iterdir()) == before
    assert other.code().is_file()


def test_a_cache_that_cannot_be_written_is_done_without(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    made = Installation(tmp_path / "one", tmp_path / "file" / "cache")
    assert made.call() == "21 compiled"


def test_two_processes_may_compile_at_once(tmp_path: Path) -> None:
    made = Installation(tmp_path / "one", tmp_path / "cache")
    environment = {**os.environ, "PYTHONPATH": str(made.folder), "HWP_CACHE": str(made.cache)}
    command = [sys.executable, "-c", _PROGRAM]
    running = [
        subprocess.Popen(command, env=environment, cwd=made.folder, stdout=subprocess.PIPE)
        for _ in range(3)
    ]
    answers = [process.communicate()[0].decode().split()[0] for process in running]
    assert answers == ["21"] * 3
    assert made.call() == "21 found"
    assert {path.suffix for path in (made.cache / "kernels").iterdir()} == {".code"}
