"""Files that are whole or absent: atomic writing, bounded reading, digests, the cache folder."""

from __future__ import annotations

import contextlib
import hashlib
import json
import os
import shutil
import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from hwp_bench.errors import BadInput, HwpError, UsageError

#: Largest JSON file that is read, in bytes; a result of 10,000 frames stays far below it.
MAX_JSON_BYTES = 256 * 1024 * 1024


def atomic_write(path: str | os.PathLike[str], data: bytes | str) -> Path:
    """Write a file so that a reader sees the old content or the new one, never a part.

    Args:
        path: the file; its folder is made.
        data: bytes, or text that is stored as UTF-8.

    Returns:
        The path.

    Raises:
        HwpError: the place cannot be written (no space, no permission).
    """
    path = Path(path)
    raw = data.encode() if isinstance(data, str) else data
    temporary: str | None = None
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        handle, temporary = tempfile.mkstemp(dir=path.parent, prefix=f".{path.name}.")
        with os.fdopen(handle, "wb") as stream:
            stream.write(raw)
        # mkstemp makes private files; results are meant to be read by others.
        os.chmod(temporary, 0o644)
        os.replace(temporary, path)
    except OSError as error:
        if temporary is not None:
            with contextlib.suppress(OSError):
                os.unlink(temporary)
        raise HwpError(
            f"cannot be written ({error.strerror})",
            where=path,
            remedy="Check the free space and the permissions of the folder.",
        ) from error
    return path


@contextlib.contextmanager
def atomic_folder(path: str | os.PathLike[str], *, overwrite: bool = False) -> Iterator[Path]:
    """Fill a folder under a temporary name; it takes its own name only when the block ends well.

    Args:
        path: the folder to make.
        overwrite: replace an existing folder; without it an existing non-empty one is refused.

    Yields:
        The temporary folder, a sibling of `path`.

    Raises:
        UsageError: `path` exists and holds something, or is a file.
        HwpError: the place cannot be written.
    """
    path = Path(path).absolute()
    if path.is_file() or (path.is_dir() and any(path.iterdir()) and not overwrite):
        raise UsageError(
            "exists already", where=path, remedy="Choose another place, or allow overwriting it."
        )
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        temporary = Path(tempfile.mkdtemp(dir=path.parent, prefix=f".{path.name}."))
        os.chmod(temporary, 0o755)
    except OSError as error:
        raise HwpError(f"cannot be made ({error.strerror})", where=path) from error
    try:
        yield temporary
        retired = temporary.with_name(temporary.name + ".old")
        if path.exists():
            os.replace(path, retired)
        os.replace(temporary, path)
        shutil.rmtree(retired, ignore_errors=True)
    except OSError as error:
        shutil.rmtree(temporary, ignore_errors=True)
        raise HwpError(f"cannot be written ({error.strerror})", where=path) from error
    except BaseException:
        shutil.rmtree(temporary, ignore_errors=True)
        raise


def canonical_json(value: Any) -> str:
    """Return one spelling of a JSON value: sorted keys, no spaces, NaN refused."""
    return json.dumps(value, sort_keys=True, separators=(",", ":"), allow_nan=False)


def sha256_json(value: Any) -> str:
    """Return the SHA-256 (hex) of a JSON value's canonical spelling."""
    return hashlib.sha256(canonical_json(value).encode()).hexdigest()


def sha256_file(path: str | os.PathLike[str]) -> str:
    """Return the SHA-256 (hex) of a file's bytes."""
    with open(path, "rb") as stream:
        return hashlib.file_digest(stream, "sha256").hexdigest()


def read_json(path: str | os.PathLike[str], *, max_bytes: int = MAX_JSON_BYTES) -> Any:
    """Read a JSON file from outside.

    Raises:
        BadInput: the file is missing, larger than `max_bytes`, not UTF-8, not JSON, or nested
            too deeply.
    """
    path = Path(path)
    try:
        size = path.stat().st_size
        if size > max_bytes:
            raise BadInput(
                f"holds {size} bytes, more than the {max_bytes} that are read", where=path
            )
        return json.loads(path.read_text(encoding="utf-8"), parse_constant=_refuse_constant)
    except FileNotFoundError as error:
        raise BadInput("does not exist", where=path) from error
    except OSError as error:
        raise BadInput(f"cannot be read ({error.strerror})", where=path) from error
    except UnicodeDecodeError as error:
        raise BadInput("is not UTF-8 text", where=path) from error
    except RecursionError as error:
        raise BadInput("is nested too deeply", where=path) from error
    except ValueError as error:
        raise BadInput(f"is not valid JSON ({error})", where=path) from error


def _refuse_constant(name: str) -> float:
    raise ValueError(f"{name} is no JSON number")


def write_json(path: str | os.PathLike[str], value: Any) -> Path:
    """Write a JSON file atomically, indented, keys in the order given, NaN refused."""
    return atomic_write(path, json.dumps(value, indent=1, allow_nan=False) + "\n")


def inside(root: str | os.PathLike[str], relative: str) -> Path:
    """Join a path from outside to a folder, refusing whatever leads out of the folder.

    Raises:
        BadInput: `relative` is absolute, climbs with `..`, or passes a link that leaves `root`.
    """
    base = Path(root).resolve()
    target = (base / relative).resolve()
    if Path(relative).is_absolute() or not target.is_relative_to(base):
        raise BadInput(
            f"the path {relative!r} leads out of the folder",
            where=root,
            remedy="Use a path inside it.",
        )
    return target


def cache_root() -> Path:
    """Return the folder for what can be made again: HWP_CACHE, else the user's cache folder."""
    if "HWP_CACHE" in os.environ:
        return Path(os.environ["HWP_CACHE"]).expanduser()
    base = os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache"
    return Path(base) / "hwp-bench"
