"""What a method consists of, as a digest: code, settings and weights."""

from __future__ import annotations

import hashlib
from collections.abc import Iterable
from functools import lru_cache
from pathlib import Path

from hwp_bench.files import sha256_file

#: Names of files that decide what a method does end in one of these; logs and pictures do not.
CONTENT = frozenset(
    {".py", ".toml", ".json", ".yaml", ".yml", ".safetensors", ".pt", ".pth", ".ckpt", ".npz"}
    | {".npy", ".onnx", ".pkl", ".bin"}
)


def method_digest(root: Path) -> str:
    """SHA-256 (hex) of a method's own code, settings and weights.

    Args:
        root: the method's folder; links and hidden folders in it are left out.
    """
    return _digest(root, (path for path in _files(root) if path.suffix in CONTENT))


def exposed_digest(paths: Iterable[Path]) -> str:
    """SHA-256 (hex) of everything that a method may read besides its own folder.

    Where it lies does not enter, so that the same files give the same digest on every machine.

    Args:
        paths: files and folders, in the order in which they were named. One that is missing
            counts as empty.
    """
    parts = [sha256_of(path) if path.is_file() else _digest(path, _files(path)) for path in paths]
    return hashlib.sha256("\n".join(parts).encode()).hexdigest()


def sha256_of(path: Path) -> str:
    """SHA-256 (hex) of a file, read again only when its size or date has changed."""
    facts = path.stat()
    return _sha256(path, facts.st_size, facts.st_mtime_ns)


@lru_cache(maxsize=4096)
def _sha256(path: Path, size: int, modified: int) -> str:
    return sha256_file(path)


def _files(root: Path) -> Iterable[Path]:
    """Regular files below a folder that no hidden folder and no cache holds."""
    for path in sorted(root.rglob("*")):
        parents = path.relative_to(root).parts[:-1]
        odd = any(name.startswith(".") or name == "__pycache__" for name in parents)
        if not odd and path.is_file() and not path.is_symlink():
            yield path


def _digest(root: Path, files: Iterable[Path]) -> str:
    total = hashlib.sha256()
    for path in files:
        total.update(f"{path.relative_to(root).as_posix()}\0{sha256_of(path)}\0".encode())
    return total.hexdigest()
