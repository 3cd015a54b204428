"""Style, types and the shape of the tree. Oracles: ruff, mypy, vulture, line counts."""

from __future__ import annotations

import ast
import functools
import re
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
#: The names that vulture takes for unused and that are not.
ALLOWED = ROOT / "tools" / "vulture_allow.py"
SOURCES = [
    path
    for folder in ("hwp_bench", "wildghand", "baselines", "benchmarks", "tests", "tools")
    for path in sorted((ROOT / folder).rglob("*.py"))
]


@pytest.mark.slow
@pytest.mark.parametrize(
    "command",
    [("ruff", "check", "."), ("ruff", "format", "--check", "."), ("mypy",)],
    ids=["ruff check", "ruff format", "mypy"],
)
def test_linters_find_nothing(command: tuple[str, ...]) -> None:
    done = subprocess.run(
        [sys.executable, "-m", *command], cwd=ROOT, capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stdout + done.stderr


@functools.cache
def unused() -> dict[str, str]:
    """What vulture takes for unused: its message by name."""
    folders = ("hwp_bench", "wildghand", "baselines")
    # The names that stubs list are public.
    stubs = [str(path) for folder in folders for path in (ROOT / folder).rglob("*.pyi")]
    command = ("vulture", *folders, *stubs)
    done = subprocess.run(
        [sys.executable, "-m", *command], cwd=ROOT, capture_output=True, text=True, check=False
    )
    assert done.returncode in (0, 3), done.stdout + done.stderr
    lines = done.stdout.splitlines()
    found = {re.findall(r"unused \w+(?: \w+)? '(\w+)'", line)[0]: line for line in lines}
    return {name: line for name, line in found.items() if name != "_"}


def test_dead_code_is_what_only_looks_dead_and_has_a_reason() -> None:
    rows = [line for line in ALLOWED.read_text("utf-8").split('"""')[2].splitlines() if line]
    entries = [re.fullmatch(r"(?:_\.)?(\w+)  # (\S.{8,})", row) for row in rows]
    assert all(entries), rows
    names = [entry[1] for entry in entries if entry]
    assert len(names) == len(set(names))
    assert [line for name, line in unused().items() if name not in names] == []
    assert set(names) - set(unused()) == set()


def test_modules_are_readable_from_top_to_bottom() -> None:
    lengths = {path: len(path.read_text(encoding="utf-8").splitlines()) for path in SOURCES}
    assert len(lengths) > 300
    assert {path: length for path, length in lengths.items() if length > 700} == {}


def test_the_benchmark_never_imports_the_methods() -> None:
    for path in (ROOT / "hwp_bench").rglob("*.py"):
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            names = []
            if isinstance(node, ast.Import):
                names = [alias.name for alias in node.names]
            elif isinstance(node, ast.ImportFrom):
                names = [node.module or ""]
            for name in names:
                assert name.split(".")[0] not in {"wildghand", "baselines"}, path
