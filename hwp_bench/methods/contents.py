"""Digests of the content of a method: every file of its folder, and what it is shown besides."""

from __future__ import annotations

import hashlib
import os
import re
import stat
from collections.abc import Collection, Iterable, Iterator, Mapping
from pathlib import Path

from hwp_bench.base.errors import BadInput, BadMethod, UsageError
from hwp_bench.base.files import sha256_of
from hwp_bench.base.folders import LOCK

#: Folders that do not count, at any depth: what version control, Python and editors make again.
#: A method in a sandbox finds them empty, so that nothing that decides a score can lie there.
LEFT_OUT = frozenset(
    {"__pycache__", ".git", ".hg", ".svn", ".idea", ".vscode", ".ipynb_checkpoints"}
    | {".mypy_cache", ".ruff_cache", ".pytest_cache"}
)
#: Most files of a folder whose digest is taken, and most bytes in them.
MAX_FILES, MAX_BYTES = 200_000, 64 << 30
#: Most folders of a method that are looked into.
MAX_FOLDERS = 20_000
#: Files that say that a folder is a capture or a result of the toolkit, by their first words.
_MARKED_FILES = ("capture.json", "results.json")
_MARK, _HEAD_BYTES = b'"hwp-', 256
#: How `base.files.temporary_name` calls what a killed run leaves half written.
_TEMPORARY = re.compile(r"\..+\.[0-9a-f]{12}(\.old)?")
_INTERPRETER = re.compile(r"/bin/python[^/]*$")
#: The file that makes a folder an environment of Python.
_ENVIRONMENT = "pyvenv.cfg"


def method_files(root: Path) -> dict[str, str]:
    """Return the SHA-256 (hex) of each file and link of a method by its name below the folder.

    Code, settings, weights and anything else count, at any depth and whatever they end with. Left
    out are folders in `LEFT_OUT`, and captures and outputs of runs (`is_foreign`). A link counts by
    its name and the place that it leads to: a file inside the folder counts itself, and what lies
    outside of it is refused by `refuse_links_out`.
    """
    return _digests(root, own=True)


def digest_of(files: Mapping[str, str]) -> str:
    """Return the digest of a folder from those of its files, `method_files`."""
    total = hashlib.sha256()
    for name, digest in sorted(files.items()):
        total.update(f"{name}\0".encode(errors="surrogateescape"))
        total.update(bytes.fromhex(digest))
    return total.hexdigest()


def exposed_digest(paths: Iterable[Path]) -> str:
    """SHA-256 (hex) of everything that a method may read besides its own folder.

    The place does not count, so that the same files give the same digest on every machine.
    """
    parts = [
        _file_digest(path) if path.is_file() else digest_of(_digests(path, own=False))
        for path in paths
    ]
    return hashlib.sha256("\n".join(parts).encode()).hexdigest()


def unseen_folders(root: Path, *, ships: bool = False) -> list[Path]:
    """Return the folders below a method's that it finds empty inside the sandbox.

    Captures and outputs of runs, which hold true frames (`is_foreign`), and what is in no digest
    (`LEFT_OUT`). The latter stays in a method that ships, and in an environment of Python: what is
    compiled there belongs to packages. Links are not followed; inside they lead nowhere.
    """
    found: list[Path] = []
    waiting, seen = [(root, not ships)], 0
    while waiting:
        folder, strict = waiting.pop()
        entries = _scan(folder)
        seen += 1
        if seen > MAX_FOLDERS:
            raise UsageError(
                f"holds more than {MAX_FOLDERS} folders, too many to tell what is the method's",
                where=root,
                remedy="Keep the method in a folder of its own.",
            )
        if folder != root and is_foreign(folder, [entry.name for entry in entries]):
            found.append(folder)
            continue
        strict = strict and (folder == root or not (folder / _ENVIRONMENT).is_file())
        for path in (Path(e.path) for e in entries if e.is_dir(follow_symlinks=False)):
            if strict and path.name in LEFT_OUT:
                found.append(path)
            else:
                waiting.append((path, strict))
    return sorted(found)


def is_foreign(folder: str | os.PathLike[str], names: Collection[str]) -> bool:
    """Return whether a folder below a method's is a capture or an output of a run.

    A capture and a results file are known by what they begin with, an output that is not finished
    by its lock file or its temporary name. A method in a sandbox finds such folders empty.
    """
    if _TEMPORARY.fullmatch(os.path.basename(folder)) or LOCK in names:
        return True
    return any(name in names and _marked(os.path.join(folder, name)) for name in _MARKED_FILES)


def _marked(path: str) -> bool:
    try:
        with open(os.open(path, os.O_RDONLY | os.O_NONBLOCK), "rb") as stream:
            return _MARK in stream.read(_HEAD_BYTES)
    except OSError:
        # What cannot be read cannot be told apart from a capture.
        return True


def refuse_links_out(root: Path, exposed: Iterable[Path]) -> None:
    """Refuse a method with a link to something that is in no digest."""
    top = root.resolve()
    shown = [path.resolve() for path in exposed]
    for name, entry in _entries(root, own=True):
        if not entry.is_symlink():
            continue
        target = _target(Path(entry.path))
        if not target.exists() or any(target.is_relative_to(place) for place in shown):
            continue
        if target.is_relative_to(top):
            if LEFT_OUT.isdisjoint(target.relative_to(top).parts):
                continue
        # The Python of an environment always leads out of it.
        elif (Path(entry.path).parent.parent / _ENVIRONMENT).is_file() and _INTERPRETER.search(
            entry.path
        ):
            continue
        raise BadMethod(
            f"is a link to {target}, which is not a part of the method's digest",
            where=root / name,
            remedy="Put a copy in its place, or show the method that place with --expose: a score "
            "stands under the digest of everything that decides it.",
        )


def _digests(root: Path, *, own: bool) -> dict[str, str]:
    top, found = root.resolve(), {}
    for name, entry in _entries(root, own=own):
        if entry.is_symlink():
            target = _target(Path(entry.path))
            inside = target.is_relative_to(top)
            text = os.path.relpath(target, top) if inside else os.readlink(entry.path)
            link = f"link\0{text}".encode(errors="surrogateescape")
            found[name] = hashlib.sha256(link).hexdigest()
        else:
            found[name] = _file_digest(Path(entry.path))
    return found


def _target(link: Path) -> Path:
    """The place that a link leads to; the link itself where it leads round in circles."""
    try:
        return link.resolve()
    except (OSError, RuntimeError):
        return link


def _file_digest(path: Path) -> str:
    try:
        return sha256_of(path)
    except OSError as error:
        raise _unreadable(path, error) from error


def _entries(root: Path, *, own: bool) -> Iterator[tuple[str, os.DirEntry[str]]]:
    """Yield the name below a folder and the entry of each regular file and link in it."""
    waiting, count, size = [root], 0, 0
    while waiting:
        folder = waiting.pop()
        entries = _scan(folder)
        if own and folder != root and is_foreign(folder, [entry.name for entry in entries]):
            continue
        for entry in entries:
            facts = entry.stat(follow_symlinks=False)
            if stat.S_ISDIR(facts.st_mode):
                if not own or entry.name not in LEFT_OUT:
                    waiting.append(Path(entry.path))
                continue
            if not (stat.S_ISREG(facts.st_mode) or stat.S_ISLNK(facts.st_mode)):
                continue
            count, size = count + 1, size + facts.st_size
            if count > MAX_FILES or size > MAX_BYTES:
                raise BadInput(
                    f"holds more than {MAX_FILES} files or {MAX_BYTES >> 30} GiB, too much for a "
                    "digest of what decides a score",
                    where=root,
                    remedy="Keep data sets, runs and outputs in another folder.",
                )
            yield Path(entry.path).relative_to(root).as_posix(), entry


def _scan(folder: Path) -> list[os.DirEntry[str]]:
    if not folder.is_dir():
        return []
    try:
        with os.scandir(folder) as entries:
            return list(entries)
    except OSError as error:
        raise _unreadable(folder, error) from error


def _unreadable(path: Path, error: OSError) -> BadInput:
    return BadInput(
        f"cannot be read ({error.strerror}), and would be missing from the digest",
        where=path,
        remedy="Change its permissions, or move it elsewhere.",
    )
