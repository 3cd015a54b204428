"""The folders of Python that a sandbox shows: the interpreter, its packages, the toolkit.

The list is fixed: another interpreter is shown only where a person names it (`--expose`).
"""

from __future__ import annotations

import os
import site
import sys
from collections.abc import Iterable
from glob import escape, glob
from pathlib import Path

from hwp_bench.base.packages import PACKAGES

#: Files that a project has at its top, next to what nobody needs who imports it.
_PROJECT_MARKS = ("pyproject.toml", "setup.py", "setup.cfg", ".git")


def python_places() -> list[str]:
    """Return the folders of this interpreter, its packages and the toolkit."""
    sites = _sites()
    linked = [path for folder in _linked(sites) for path in of_packages(folder)]
    return [sys.prefix, sys.base_prefix, *of_packages(os.fspath(PACKAGES)), *sites, *linked]


def _sites() -> list[str]:
    return [*site.getsitepackages(), site.getusersitepackages()]


def of_packages(folder: str) -> list[str]:
    """Return what is shown of a folder on the path: of a project, its packages and modules.

    Methods need nothing else of it, such as tests, runs, history and files with secrets.
    """
    real = os.path.realpath(folder)
    if not any(os.path.exists(os.path.join(real, mark)) for mark in _PROJECT_MARKS):
        return [folder]
    packages = [os.path.dirname(path) for path in glob(f"{escape(real)}/*/__init__.py")]
    modules = [path for end in ("py", "so") for path in glob(f"{escape(real)}/*.{end}")]
    return packages if _is_checkout(real) else [*packages, *modules]


def checkout() -> list[str]:
    """Return the toolkit's checkout, to be hidden where it lies in a folder that is shown."""
    root = os.path.realpath(PACKAGES)
    return [root] if _is_checkout(root) else []


def _is_checkout(folder: str) -> bool:
    files = ("hwp_bench/__init__.py", "pyproject.toml")
    return all(os.path.isfile(os.path.join(folder, file)) for file in files)


def _linked(sites: Iterable[str]) -> list[str]:
    """Return the folders that `.pth` files add, as editable installs do."""
    files = [path for folder in sites for path in glob(f"{folder}/*.pth")]
    lines = [line for path in files for line in Path(path).read_text(errors="replace").splitlines()]
    return [line.strip() for line in lines if os.path.isabs(line) and os.path.isdir(line.strip())]
