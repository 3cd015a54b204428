"""Named arrays from others: no pickles, sizes bounded, shapes checked; tables of tensors."""

from __future__ import annotations

import io
import math
import os
import zipfile
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from hwp_bench.base.errors import BadInput, shown
from hwp_bench.base.files import atomic_write, check_is_file

if TYPE_CHECKING:
    from torch import Tensor


#: Largest array file that is read, unpacked, in bytes (a zip can unpack to a thousand times).
MAX_NPZ_BYTES = 1024 * 1024 * 1024
#: Most arrays of a file: each takes some 0.1 ms to read, however small it is.
MAX_MEMBERS = 10_000
#: Largest directory of an archive, bytes: that of so many arrays has less than a tenth of it.
MAX_DIRECTORY = 8 << 20


def read_npz(
    path: str | os.PathLike[str], *, max_bytes: int = MAX_NPZ_BYTES
) -> dict[str, np.ndarray]:
    """Read every array of an `.npz` file."""
    path = Path(path)
    check_is_file(path)
    try:
        _check_directory(path)
        with zipfile.ZipFile(path) as archive:
            members = archive.infolist()
            unpacked = sum(item.file_size for item in members)
            if unpacked > max_bytes:
                raise BadInput(
                    f"unpacks to {unpacked} bytes, more than the {max_bytes} that are read",
                    where=path,
                )
            names = [item.filename for item in members]
            if len(names) > MAX_MEMBERS or len(set(names)) < len(names):
                twice = f"more than {MAX_MEMBERS:,} arrays, or one twice"
                raise BadInput(f"holds {twice}", where=path)
            return {item.filename.removesuffix(".npy"): _member(archive, item) for item in members}
    except BadInput:
        raise
    # A damaged archive can raise whatever a decompressor or numpy's parser of headers raises.
    except Exception as error:
        raise BadInput(
            f"is not a readable array file ({shown(str(error))[:200]})",
            where=path,
            remedy="It must be an .npz of plain arrays.",
        ) from error


def _check_directory(path: Path) -> None:
    """Refuse a directory that is too large, before zipfile makes an object of each entry."""
    with path.open("rb") as stream:
        stream.seek(max(0, path.stat().st_size - 22 - 65535))
        tail = stream.read()
    end = len(tail) - 22  # where zipfile looks first: there is no comment
    if tail[end : end + 4] != b"PK\5\6" or tail[-2:] != b"\0\0":
        end = tail.rfind(b"PK\5\6")
    if end >= 0 and int.from_bytes(tail[end + 12 : end + 16], "little") > MAX_DIRECTORY:
        raise BadInput(f"holds more than {MAX_MEMBERS:,} arrays, or one twice", where=path)


def _member(archive: zipfile.ZipFile, item: zipfile.ZipInfo) -> np.ndarray:
    """Read one array, after checking the size that its header states."""
    with archive.open(item) as stream:
        version = np.lib.format.read_magic(stream)
        readers = {
            (1, 0): np.lib.format.read_array_header_1_0,
            (2, 0): np.lib.format.read_array_header_2_0,
        }
        if version not in readers:
            raise ValueError(f"{item.filename} is an array of version {version}")
        shape, _, dtype = readers[version](stream)
        if dtype.itemsize == 0:
            raise ValueError(f"{item.filename} has elements of no bytes")
        claimed = math.prod(shape) * dtype.itemsize
        if claimed > item.file_size:
            raise ValueError(f"{item.filename} claims {claimed} bytes and has {item.file_size}")
    with archive.open(item) as stream:
        return np.lib.format.read_array(stream, allow_pickle=False)


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
    most: float = math.inf,
) -> np.ndarray:
    """Take one array out of a file and check it.

    A length of None in its shape is any, floats must be finite and not beyond `most`; the first bad
    row is named.
    """
    if name not in arrays:
        raise BadInput("is missing", where=where, field=name)
    array = arrays[name]
    if len(array.shape) != len(shape) or any(
        size is not None and got != size for got, size in zip(array.shape, shape, strict=True)
    ):
        expected = "(" + ", ".join("any" if n is None else str(n) for n in shape) + ")"
        raise BadInput(
            f"has shape {array.shape} where {expected} is expected", where=where, field=name
        )
    kinds = "b" if dtype is bool else "fiu"
    if array.dtype.kind not in kinds:
        raise BadInput(f"has type {array.dtype}, not {dtype.__name__}", where=where, field=name)
    array = np.ascontiguousarray(array, dtype=dtype)
    if dtype is not bool and not np.isfinite(array).all():
        rows = ~np.isfinite(array.reshape(len(array), -1)).all(axis=1) if array.ndim else []
        first = int(np.argmax(rows)) if array.ndim else 0
        raise BadInput(f"holds NaN or infinity (first in row {first})", where=where, field=name)
    if array.size and dtype is not bool and np.abs(array).max() > most:
        row = int(np.unravel_index(np.abs(array).argmax(), array.shape)[0]) if array.ndim else 0
        raise BadInput(f"holds a number beyond {most:g} (row {row})", where=where, field=name)
    return array


def read_tensors(path: str | os.PathLike[str], max_bytes: int) -> dict[str, Tensor]:
    """Read tensors by name; nothing else that a file may hold is made or run."""
    import torch

    file = Path(path)
    check_is_file(file)
    if file.stat().st_size > max_bytes:
        raise BadInput(f"is larger than {max_bytes} bytes", where=file)
    try:
        if file.suffix == ".safetensors":
            from safetensors.torch import load_file

            return load_file(file)
        mapped = zipfile.is_zipfile(file)
        loaded = torch.load(file, map_location="cpu", weights_only=True, mmap=mapped)
    # A damaged file may raise anything in its reader.
    except Exception as error:
        text = (str(error).splitlines() or [""])[0][:200]
        raise BadInput(f"cannot be read ({type(error).__name__}: {text})", where=file) from error
    if not isinstance(loaded, dict) or not all(isinstance(name, str) for name in loaded):
        raise BadInput("is not a table of parameters", where=file)
    return {name: value for name, value in loaded.items() if isinstance(value, torch.Tensor)}


def surrounding(region: np.ndarray, margin: int) -> tuple[slice, slice]:
    """Rows and columns of a region (H, W) bool, not empty, with a margin where the image has it."""
    rows, columns = (np.flatnonzero(region.any(axis=axis)) for axis in (1, 0))
    return (
        slice(max(int(rows[0]) - margin, 0), int(rows[-1]) + 1 + margin),
        slice(max(int(columns[0]) - margin, 0), int(columns[-1]) + 1 + margin),
    )


def evenly(count: int, most: int) -> np.ndarray:
    """Choose at most some of `count` things in a row, from the first to the last.

    Returns:
        (K,) int64, their numbers, ascending and all different; all of them where `count` is not
        larger than `most`.
    """
    return np.unique(np.linspace(0, count - 1, min(count, most)).round().astype(np.int64))
