"""Packages whose names are imported when first asked for. Oracle: the modules in their stubs."""

from __future__ import annotations

import ast
import importlib
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
STUBS = sorted(
    path for package in ("hwp_bench", "wildghand") for path in (ROOT / package).rglob("*.pyi")
)


def _name(stub: Path) -> str:
    return ".".join(stub.parent.relative_to(ROOT).parts)


@pytest.mark.parametrize("stub", STUBS, ids=_name)
def test_every_name_is_what_its_module_defines(stub: Path) -> None:
    package = importlib.import_module(_name(stub))
    names = set()
    for node in ast.parse(stub.read_text(encoding="utf-8")).body:
        if isinstance(node, ast.ImportFrom):
            module = importlib.import_module("." * node.level + (node.module or ""), _name(stub))
            for alias in node.names:
                assert alias.asname == alias.name, "type checkers read `name as name`"
                assert getattr(package, alias.name) is getattr(module, alias.name)
                names.add(alias.name)
    assert set(dir(package)) == set(package.__all__) == names


@pytest.mark.parametrize("stub", STUBS, ids=_name)
def test_importing_the_package_loads_no_torch(stub: Path) -> None:
    code = f"import sys, {_name(stub)}; sys.exit('torch' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", code], cwd=ROOT, check=False).returncode == 0
