"""Folders that stay empty for a method, even inside places that it may read.

The scenes and seeds of the public suites are in the toolkit, and so is the program that renders
them: a method that could run it would render the test frames again. Hiding it here stops a method
from using ours. It does not stop one that brings a copy; sealed suites do
(`docs/threat-model.md`).
"""

from __future__ import annotations

import os
from pathlib import Path

from hwp_bench.base.packages import PACKAGES

#: Packages of the toolkit that no method needs: the simulator, with its scenes and seeds.
WITHHELD = ("hwp_bench/sim",)
#: Files that tell a folder of results, or a capture, from a method's own.
_MARKS = frozenset({"results.json", "result.json", "capture.json", "ablation.json"})
# How far a method's directory is searched. A larger one than this holds data, not a method.
_DEPTH, _ENTRIES = 6, 20_000


def withheld_packages() -> list[Path]:
    """Return the folders of the toolkit's packages that are hidden from methods."""
    return [PACKAGES / name for name in WITHHELD]


def runs_below(method: Path) -> list[Path]:
    """Return folders of results and captures inside a method's directory: they hold test frames.

    The default output of `hwp-bench evaluate` is `runs/` where it is started, which may be there.

    Args:
        method: the directory.

    Returns:
        The outermost of them. A directory that is too large or too deep to be searched is searched
        as far as that, and what lies deeper is hidden as a whole.
    """
    found: list[Path] = []
    seen = 0
    for folder, names, files in os.walk(method):
        depth = len(Path(folder).relative_to(method).parts)
        seen += len(names) + len(files)
        if depth and not _MARKS.isdisjoint(files):
            found.append(Path(folder))
            names.clear()
        elif depth >= _DEPTH or seen > _ENTRIES:
            found += [Path(folder) / name for name in names]
            names.clear()
    return found
