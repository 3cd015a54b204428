"""Named arrays on disk (`.npz`) from others: no pickles, sizes bounded, shapes checked."""

from __future__ import annotations

import io
import os
import zipfile
from collections.abc import Mapping
from pathlib import Path

import numpy as np

from hwp_bench.errors import BadInput
from hwp_bench.files import atomic_write

#: Largest array file that is read, unpacked, in bytes (a zip can unpack to a thousand times).
MAX_NPZ_BYTES = 1024 * 1024 * 1024


def read_npz(
    path: str | os.PathLike[str], *, max_bytes: int = MAX_NPZ_BYTES
) -> dict[str, np.ndarray]:
    """Read every array of an `.npz` file.

    Raises:
        BadInput: missing, damaged, larger than `max_bytes` when unpacked, or holding objects.
    """
    path = Path(path)
    if not path.is_file():
        raise BadInput("does not exist", where=path)
    try:
        with zipfile.ZipFile(path) as archive:
            unpacked = sum(item.file_size for item in archive.infolist())
        if unpacked > max_bytes:
            raise BadInput(
                f"unpacks to {unpacked} bytes, more than the {max_bytes} that are read", where=path
            )
        with np.load(path, allow_pickle=False) as archive:
            return {name: archive[name] for name in archive.files}
    except (OSError, ValueError, EOFError, KeyError, zipfile.BadZipFile) as error:
        raise BadInput(
            f"is no readable array file ({error})",
            where=path,
            remedy="It must be an .npz of plain arrays.",
        ) from error


def write_npz(path: str | os.PathLike[str], arrays: Mapping[str, np.ndarray]) -> Path:
    """Write arrays to an `.npz` file atomically."""
    buffer = io.BytesIO()
    np.savez_compressed(buffer, allow_pickle=False, **dict(arrays))
    return atomic_write(path, buffer.getvalue())


def take(
    arrays: Mapping[str, np.ndarray],
    name: str,
    shape: tuple[int | None, ...],
    *,
    where: str | os.PathLike[str],
    dtype: type = np.float64,
) -> np.ndarray:
    """Take one array out of a file and check it.

    Args:
        arrays: what the file holds.
        name: which array.
        shape: expected shape; None admits any length.
        where: the file, for the message.
        dtype: wanted type; floats must be finite.

    Returns:
        The array as `dtype`.

    Raises:
        BadInput: absent, of another shape or kind, or not finite; the first bad row is named.
    """
    if name not in arrays:
        raise BadInput("is missing", where=where, field=name)
    array = arrays[name]
    if len(array.shape) != len(shape) or any(
        wanted is not None and got != wanted for got, wanted in zip(array.shape, shape, strict=True)
    ):
        wanted_text = "(" + ", ".join("any" if n is None else str(n) for n in shape) + ")"
        raise BadInput(
            f"has shape {array.shape} where {wanted_text} is expected", where=where, field=name
        )
    kinds = "b" if dtype is bool else "fiu"
    if array.dtype.kind not in kinds:
        raise BadInput(f"has type {array.dtype}, not {dtype.__name__}", where=where, field=name)
    array = np.ascontiguousarray(array, dtype=dtype)
    if dtype is not bool and not np.isfinite(array).all():
        rows = ~np.isfinite(array.reshape(len(array), -1)).all(axis=1) if array.ndim else []
        first = int(np.argmax(rows)) if array.ndim else 0
        raise BadInput(f"holds NaN or infinity (first in row {first})", where=where, field=name)
    return array
