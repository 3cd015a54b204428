"""Compiling leaves Python's collector of garbage as it was; oracle: what the collector says."""

from __future__ import annotations

import gc
import hashlib
import os
import shutil
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from numba.core import event
from numba.core.errors import TypingError

from hwp_bench.base import kernels
from hwp_bench.base.kernels import compiled, kernel_digest, kernel_modules
from hwp_bench.base.packages import PACKAGES


@pytest.fixture(autouse=True)
def _collector() -> Iterator[None]:
    on = gc.isenabled()
    yield
    (gc.enable if on else gc.disable)()


class _Seen(event.Listener):  # type: ignore[misc]
    """Whether the collector is on where numba starts to compile."""

    def __init__(self) -> None:
        self.on: list[bool] = []

    def on_start(self, event: Any) -> None:
        self.on.append(gc.isenabled())

    def on_end(self, event: Any) -> None:
        pass


@pytest.mark.parametrize("on", [True, False])
def test_the_collector_rests_while_a_kernel_is_compiled(on: bool) -> None:
    @compiled()
    def double(x: Any) -> Any:
        return x + x

    (gc.enable if on else gc.disable)()
    seen = _Seen()
    with event.install_listener("numba:compile", seen):
        assert double(2) == 4
    assert seen.on == [False]
    assert gc.isenabled() == on


def test_a_kernel_that_cannot_be_compiled_leaves_it_on() -> None:
    @compiled()
    def impossible(x: Any) -> Any:
        return x + "one"

    gc.enable()
    with pytest.raises(TypingError):
        impossible(2)
    assert gc.isenabled()


@pytest.fixture
def root(tmp_path: Path) -> Path:
    texts = {
        "hwp_bench/__init__.py": "import hwp_bench.unrelated",
        "hwp_bench/unrelated.py": "",
        "hwp_bench/base/kernels.py": "import hwp_bench.unrelated",
        "hwp_bench/room/__init__.py": "from hwp_bench.unrelated import x",
        "hwp_bench/room/kernels.py": "import numpy\nfrom hwp_bench.base.kernels import (\n  a\n)\n"
        "from hwp_bench.room import constants as at\nfrom hwp_bench.room.helpers import f",
        "hwp_bench/room/constants.py": "",
        "hwp_bench/room/helpers.py": "def f():\n    from hwp_bench.room.deep import g",
        "hwp_bench/room/deep.py": "import hwp_bench.room.last",
        "hwp_bench/room/last.py": "from hwp_bench.room import kernels",
        "hwp_bench/room/taker.py": "from hwp_bench.room import name",
    }
    for name, text in texts.items():
        path = tmp_path / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(text)
    return tmp_path


def test_imports_are_followed_and_machinery_is_not(root: Path) -> None:
    found = kernel_modules("hwp_bench.room.kernels", root)
    names = ("constants", "deep", "helpers", "kernels", "last")
    assert list(found) == ["hwp_bench.base.kernels", *(f"hwp_bench.room.{name}" for name in names)]


def test_a_name_that_is_no_module_stands_in_the_package(root: Path) -> None:
    found = kernel_modules("hwp_bench.room.taker", root)
    assert {"hwp_bench.room", "hwp_bench.unrelated"} < set(found)


@pytest.mark.parametrize(
    ("module", "also"),
    [
        ("wildghand.splat.kernels.blend", "wildghand.splat.conventions"),
        ("wildghand.splat.kernels.blend", "wildghand.splat.kernels.vectors"),
        ("wildghand.model.dress_kernels", "wildghand.splat.kernels.jit"),
        ("hwp_bench.hands.raster", None),
    ],
)
def test_kernels_depend_on_little(module: str, also: str | None) -> None:
    """A release that leaves them alone finds its machine code."""
    found = set(kernel_modules(module))
    assert found >= {module, *([also] if also else [])}
    assert all(
        name == module
        or name.startswith(
            ("hwp_bench.base.kernels", "wildghand.splat.kernels.", "wildghand.splat.conv")
        )
        for name in found
    )


def test_source_that_changed_since_the_start_gives_no_digest(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """What was imported may be another text than what the file holds now."""
    kernel_digest.cache_clear()
    assert kernel_digest("hwp_bench.hands.raster") is not None
    kernel_digest.cache_clear()
    monkeypatch.setattr(kernels, "_STARTED", 0.0)
    assert kernel_digest("hwp_bench.hands.raster") is None
    kernel_digest.cache_clear()


def test_modules_of_others_give_no_digest() -> None:
    assert kernel_digest("numpy.linalg") is None
    assert kernel_digest("hwp_bench.no_such_module") is None


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
                # Python's own code files know a source by its second and size alone.
                "PYTHONDONTWRITEBYTECODE": "1",
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
    for damaged in (raw[:half], flipped, inner.read_bytes()):
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
