"""Digests of the content of a method: code, settings and weights."""

from __future__ import annotations

import hashlib
from collections.abc import Iterable
from pathlib import Path

from hwp_bench.base.files import files_digest, sha256_of

#: Suffixes of the files that decide what a method does; logs and images are left out.
CONTENT = frozenset(
    {".py", ".toml", ".json", ".yaml", ".yml", ".safetensors", ".pt", ".pth", ".ckpt", ".npz"}
    | {".npy", ".onnx", ".pkl", ".bin"}
)


def method_digest(root: Path) -> str:
    """SHA-256 (hex) of a method's own code, settings and weights.

    Args:
        root: the method's folder; links and hidden folders in it are left out.
    """
    return files_digest(root, (path for path in _files(root) if path.suffix in CONTENT))


def exposed_digest(paths: Iterable[Path]) -> str:
    """SHA-256 (hex) of everything that a method may read besides its own folder.

    The place does not count, so that the same files give the same digest on every machine.

    Args:
        paths: files and folders, in the order in which they were named. One that is missing
            counts as empty.
    """
    parts = [
        sha256_of(path) if path.is_file() else files_digest(path, _files(path)) for path in paths
    ]
    return hashlib.sha256("\n".join(parts).encode()).hexdigest()


def _files(root: Path) -> Iterable[Path]:
    """Regular files below a folder, but not those in hidden folders and caches."""
    for path in root.rglob("*"):
        parents = path.relative_to(root).parts[:-1]
        odd = any(name.startswith(".") or name == "__pycache__" for name in parents)
        if not odd and path.is_file() and not path.is_symlink():
            yield path
