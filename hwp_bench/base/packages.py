"""The toolkit's own packages: version, folders, names that are loaded when they are first used."""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Callable, Mapping
from functools import cache
from importlib import import_module
from pathlib import Path
from typing import Any

from hwp_bench.base.errors import HwpError, MissingDependency, one_line

__version__ = "0.1.0"


#: Folder that holds the packages `hwp_bench` and `wildghand`.
PACKAGES = Path(__file__).resolve().parents[2]


def data_folder(name: str) -> Path:
    """Return a folder of data that ships with the toolkit.

    In an installed wheel it lies inside the package `hwp_bench`, in a checkout next to it.
    """
    for folder in (PACKAGES / "hwp_bench" / "_data" / name, PACKAGES / name):
        if folder.is_dir():
            return folder
    raise HwpError(
        f"the data folder {name!r} of the toolkit is missing",
        where=PACKAGES,
        remedy="Install the toolkit again.",
    )


def import_extra(module: str, extra: str, problem: str) -> Any:
    """Import a module that an extra of the toolkit brings.

    Raises:
        MissingDependency: it is not installed, as `problem` says, or fails when it is imported.
    """
    try:
        return import_module(module)
    except ImportError as error:
        package, remedy = module.partition(".")[0], f"pip install 'hwp-bench[{extra}]'"
        absent = error.name if isinstance(error, ModuleNotFoundError) else None
        if absent is None or absent.partition(".")[0] != package:
            reason = one_line(str(error) or type(error).__name__, 300)
            problem = f"{package} is installed and cannot be imported ({reason})"
            remedy = f"Repair it, or what it needs: {remedy}"
        raise MissingDependency(problem, remedy=remedy) from error


@cache
def checkout_commit() -> str:
    """Return the commit of the checkout, and whether its code differs; empty in a wheel."""

    def git(*words: str) -> str:
        done = subprocess.run(["git", *words], cwd=PACKAGES, capture_output=True, text=True)
        return done.stdout.strip()

    try:
        commit = git("rev-parse", "--short=10", "HEAD") if (PACKAGES / ".git").exists() else ""
        code = ("hwp_bench", "wildghand", "baselines")
        changed = commit and git("status", "--porcelain", "--", *code)
    except OSError:  # No git.
        return ""
    return commit + (" with changes" if changed else "")


def lazy_names(
    package: str, homes: Mapping[str, str]
) -> tuple[Callable[[str], Any], Callable[[], list[str]]]:
    """Return `__getattr__` and `__dir__` of a package.

    Sub-packages use `lazy_loader`. The packages themselves do not: the launcher of the sandbox
    imports `hwp_bench` in an interpreter that has only the standard library.
    """

    def __getattr__(name: str) -> Any:
        if name not in homes:
            raise AttributeError(f"module {package!r} has no attribute {name!r}")
        value = getattr(import_module(homes[name]), name)
        setattr(sys.modules[package], name, value)
        return value

    def __dir__() -> list[str]:
        return sorted({*homes, *vars(sys.modules[package])})

    return __getattr__, __dir__
