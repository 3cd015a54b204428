"""The modules that machine code depends on. Oracles: small packages written here."""

from __future__ import annotations

from pathlib import Path

import pytest

from hwp_bench.base import kernels as kernel_sources
from hwp_bench.base.kernels import kernel_digest, kernel_modules


@pytest.fixture
def root(tmp_path: Path) -> Path:
    texts = {
        "hwp_bench/__init__.py": "import hwp_bench.unrelated",
        "hwp_bench/unrelated.py": "",
        "hwp_bench/base/kernels.py": "import hwp_bench.unrelated",
        "hwp_bench/room/__init__.py": "from hwp_bench.unrelated import x",
        "hwp_bench/room/kernels.py": "import numpy\nfrom hwp_bench.base.kernels import compiled\n"
        "from hwp_bench.room import constants as at\nfrom hwp_bench.room.helpers import f",
        "hwp_bench/room/constants.py": "",
        "hwp_bench/room/helpers.py": "def f():\n    from .deep import g",
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
    assert list(found) == [f"hwp_bench.room.{name}" for name in names]


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
        name == module or name.startswith(("wildghand.splat.kernels.", "wildghand.splat.conv"))
        for name in found
    )


def test_source_that_changed_since_the_start_gives_no_digest(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """What was imported may be another text than what the file holds now."""
    kernel_digest.cache_clear()
    assert kernel_digest("hwp_bench.hands.raster") is not None
    kernel_digest.cache_clear()
    monkeypatch.setattr(kernel_sources, "_STARTED", 0.0)
    assert kernel_digest("hwp_bench.hands.raster") is None
    kernel_digest.cache_clear()


def test_modules_of_others_give_no_digest() -> None:
    assert kernel_digest("numpy.linalg") is None
    assert kernel_digest("hwp_bench.no_such_module") is None
