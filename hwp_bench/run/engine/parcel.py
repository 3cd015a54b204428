"""Folders on the way between machines: one format, one digest, nothing outside the folder."""

from __future__ import annotations

import hashlib
import io
import os
import shutil
import stat
import zipfile
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

from hwp_bench.base.errors import BadInput, HwpError
from hwp_bench.base.files import inside, temporary_name

#: Largest folder that is sent, in bytes of content.
MAX_BYTES = 8 << 30
#: Most files and folders in it.
MAX_ENTRIES = 1_000_000
#: Names that are never sent, at any depth: what Python and git make again.
LEFT_OUT = frozenset({"__pycache__", ".git"})

_EPOCH = (1980, 1, 1, 0, 0, 0)
_CHUNK = 1 << 20


@dataclass(frozen=True)
class Parcel:
    """A packed folder."""

    #: Digest of its content, as `folder_digest` says it.
    digest: str
    #: The bytes.
    data: bytes


def folder_digest(root: Path, skip: Sequence[str] = ()) -> str:
    """Return the SHA-256 (hex) of a folder: names, content, and which files can be executed.

    Args:
        root: the folder.
        skip: names directly inside it that do not count.

    Raises:
        BadInput: it is not a folder, or it holds a link, something that is not a file, or too much.
    """
    total = hashlib.sha256()
    for name, path in _entries(root, skip):
        if path.is_dir():
            total.update(f"d\0{name}\0".encode())
            continue
        with _open(path) as stream:
            content = hashlib.file_digest(stream, "sha256").digest()
        total.update(f"{_letter(path)}\0{name}\0".encode() + content)
    return total.hexdigest()


def pack(root: Path, skip: Sequence[str] = ()) -> Parcel:
    """Pack a folder.

    Raises:
        BadInput: as `folder_digest`.
    """
    total = hashlib.sha256()
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w", zipfile.ZIP_STORED) as archive:
        for name, path in _entries(root, skip):
            if path.is_dir():
                total.update(f"d\0{name}\0".encode())
                archive.writestr(zipfile.ZipInfo(f"{name}/", _EPOCH), b"")
                continue
            with _open(path) as stream:
                content = stream.read()
            letter = _letter(path)
            total.update(f"{letter}\0{name}\0".encode() + hashlib.sha256(content).digest())
            info = zipfile.ZipInfo(name, _EPOCH)
            info.external_attr = (0o755 if letter == "x" else 0o644) << 16
            archive.writestr(info, content)
    return Parcel(total.hexdigest(), buffer.getvalue())


def unpack(parcel: Parcel, target: Path, *, replace: bool = False) -> None:
    """Unpack a folder under a temporary name, check its digest, and give it its own name.

    Args:
        parcel: the packed folder, which may come from anywhere.
        target: the folder to make.
        replace: take the place of an existing folder; otherwise an existing one stays.

    Raises:
        BadInput: it is damaged, is not what its digest says, or leads out of the folder.
        HwpError: the place cannot be written.
    """
    try:
        target.parent.mkdir(parents=True, exist_ok=True)
        temporary = temporary_name(target)
        temporary.mkdir()
        try:
            _extract(parcel.data, temporary)
            if folder_digest(temporary) != parcel.digest:
                raise BadInput("arrived damaged: its digest is different", where=target)
            _swap(temporary, target, replace)
        finally:
            shutil.rmtree(temporary, ignore_errors=True)
    except OSError as error:
        raise HwpError(
            f"cannot be written ({error.strerror})",
            where=target,
            remedy="Check the free space and the permissions of the folder.",
        ) from error


def _swap(temporary: Path, target: Path, replace: bool) -> None:
    retired = temporary.with_name(f"{temporary.name}.old")
    if replace and target.exists():
        os.replace(target, retired)
    try:
        os.rename(temporary, target)
    except OSError:
        # Another process made the same folder first.
        if replace or not target.is_dir():
            raise
    shutil.rmtree(retired, ignore_errors=True)


def _extract(data: bytes, root: Path) -> None:
    try:
        with zipfile.ZipFile(io.BytesIO(data)) as archive:
            items = archive.infolist()
            if len(items) > MAX_ENTRIES or sum(item.file_size for item in items) > MAX_BYTES:
                raise BadInput("holds more than is taken", where=root)
            for item in items:
                if item.compress_type != zipfile.ZIP_STORED:
                    raise BadInput(f"{item.filename!r} is compressed", where=root)
                path = inside(root, item.filename)
                if item.is_dir():
                    path.mkdir(parents=True, exist_ok=True)
                    continue
                path.parent.mkdir(parents=True, exist_ok=True)
                # Written as plain files whatever the archive calls them, so there are no links.
                with archive.open(item) as source, open(path, "xb") as stream:
                    shutil.copyfileobj(source, stream, _CHUNK)
                if item.external_attr >> 16 & 0o100:
                    # Whoever may read it may run it; the rest of the mode is the umask's.
                    mode = path.stat().st_mode
                    path.chmod(mode | (mode & 0o444) >> 2)
    except (zipfile.BadZipFile, FileExistsError, NotADirectoryError, ValueError, EOFError) as error:
        raise BadInput(f"is damaged ({error})", where=root) from error


def _entries(root: Path, skip: Sequence[str]) -> Iterator[tuple[str, Path]]:
    """Yield (name, path) of every folder and file, in one order."""
    if not root.is_dir():
        raise BadInput("is not a folder", where=root)
    found: list[tuple[str, Path]] = []
    size = 0
    for folder, folders, files in os.walk(root, onerror=_refuse):
        top = Path(folder) == root
        left_out = LEFT_OUT | set(skip) if top else LEFT_OUT
        folders[:] = [name for name in folders if name not in left_out]
        for name in (*folders, *(file for file in files if file not in left_out)):
            path = Path(folder) / name
            facts = path.lstat()
            if not (stat.S_ISREG(facts.st_mode) or stat.S_ISDIR(facts.st_mode)):
                raise BadInput(
                    "is a link or not a plain file, and is not sent to other machines",
                    where=path,
                    remedy="Put a copy of the file in its place.",
                )
            size += facts.st_size if stat.S_ISREG(facts.st_mode) else 0
            found.append((path.relative_to(root).as_posix(), path))
    if len(found) > MAX_ENTRIES or size > MAX_BYTES:
        raise BadInput(
            f"holds {len(found)} files of {size} bytes, more than is sent to other machines",
            where=root,
            remedy=f"At most {MAX_ENTRIES} files of {MAX_BYTES >> 30} GiB.",
        )
    yield from sorted(found)


def _refuse(error: OSError) -> None:
    raise BadInput(f"cannot be read ({error.strerror})", where=error.filename) from error


def _open(path: Path) -> io.BufferedReader:
    try:
        return open(path, "rb")
    except OSError as error:
        raise BadInput(f"cannot be read ({error.strerror})", where=path) from error


def _letter(path: Path) -> str:
    return "x" if path.stat().st_mode & stat.S_IXUSR else "f"
