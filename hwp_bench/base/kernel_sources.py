"""Digest of the sources of compiled functions: their module, and what it imports of the toolkit."""

from __future__ import annotations

import ast
import functools
import hashlib
import time
from collections.abc import Iterator
from pathlib import Path

from hwp_bench.base.packages import PACKAGES

#: Packages whose imports are followed; versions stand for others.
OURS = ("hwp_bench", "wildghand")
#: Modules that compile, keep and load; they do not change what a kernel computes. How a kernel is
#: compiled is part of its key.
MACHINERY = ("hwp_bench.base.compiled", "hwp_bench.base.machine_code")

#: Source that is newer than this process may not be what was imported.
_STARTED = time.time()


@functools.cache
def kernel_digest(module: str) -> str | None:
    """Return the digest of all that a module's compiled functions are made from.

    Args:
        module: its dotted name.

    Returns:
        SHA-256 (hex) of the names and texts of the module and of what it imports of the toolkit,
        directly or not; None if the module is not of the toolkit, or some text may differ from
        what this process has imported.
    """
    if module.partition(".")[0] not in OURS or source_of(module) is None:
        return None
    digest = hashlib.sha256()
    for name, path in kernel_modules(module).items():
        status = path.stat()
        if max(status.st_mtime, status.st_ctime) >= _STARTED:
            return None
        text = path.read_bytes()
        digest.update(f"{name} {len(text)} ".encode())
        digest.update(text)
    return digest.hexdigest()


def kernel_modules(module: str, root: Path = PACKAGES) -> dict[str, Path]:
    """Return the files of a module and of all it imports of the toolkit, sorted by name.

    Args:
        module: a dotted name.
        root: the folder that holds the packages.
    """
    found: dict[str, Path] = {}
    pending = [module]
    while pending:
        name = pending.pop()
        path = source_of(name, root)
        if path is not None and name not in found and name not in MACHINERY:
            found[name] = path
            pending += _imports(path, name, root)
    return dict(sorted(found.items()))


def source_of(module: str, root: Path = PACKAGES) -> Path | None:
    """Return the file of a module or package; None if there is none."""
    place = root.joinpath(*module.split("."))
    for path in (place.with_name(f"{place.name}.py"), place / "__init__.py"):
        if path.is_file():
            return path
    return None


def _imports(path: Path, module: str, root: Path) -> Iterator[str]:
    """The toolkit's modules that a file imports, wherever in it."""
    package = module if path.name == "__init__.py" else module.rpartition(".")[0]
    for source, member in _imported_names(path.read_bytes(), package):
        # A name is a module of a package, or stands in the file itself.
        inner = f"{source}.{member}"
        yield inner if member and source_of(inner, root) else source


@functools.cache
def _imported_names(text: bytes, package: str) -> tuple[tuple[str, str], ...]:
    """The toolkit's modules that a file of a package imports, each with a name in it or with none.

    Parsing takes most of the time, and many kernels import the same files.
    """
    found = []
    for node in ast.walk(ast.parse(text)):
        if isinstance(node, ast.Import):
            found += [(alias.name, "") for alias in node.names]
        elif isinstance(node, ast.ImportFrom):
            above = package.split(".")[: len(package.split(".")) - node.level + 1]
            parts = [*(above if node.level else []), *([node.module] if node.module else [])]
            found += [(".".join(parts), alias.name) for alias in node.names]
    return tuple(pair for pair in found if pair[0].partition(".")[0] in OURS)
