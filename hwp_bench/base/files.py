"""Files that are whole or absent: atomic writing, bounded reading, digests, the cache folder."""

from __future__ import annotations

import contextlib
import errno
import hashlib
import json
import math
import os
import re
import secrets
import shutil
import stat
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from functools import lru_cache
from pathlib import Path
from typing import Any, TypeAlias

from hwp_bench.base.errors import BadInput, HwpError, UsageError, is_unicode, reason_of, shown

#: Largest JSON file that is read, in bytes; a result of 10,000 frames stays far below it.
MAX_JSON_BYTES = 256 * 1024 * 1024
#: Deepest nesting of JSON that is read: no format here needs ten levels.
MAX_JSON_DEPTH = 100
#: Largest integer that is read; above it other programs would round.
MAX_JSON_INTEGER = 2**63
# What the system says of a disc that takes no more: full, over a quota or the largest size of a
# file, closed for this user or for everybody, broken.
_DISC = frozenset(
    {errno.ENOSPC, errno.EDQUOT, errno.EFBIG, errno.EACCES, errno.EPERM, errno.EROFS, errno.EIO}
)
# Folders of one name that other processes make while one is replaced, before it gives up.
_MOST_RETIRED = 100
#: The file that makes a folder a capture, in which nothing else is written.
_CAPTURE = "capture.json"
#: Files and folders that an option names.
Places: TypeAlias = "str | os.PathLike[str] | Sequence[str | os.PathLike[str]] | None"
# Longest piece of a name that a message repeats.
_SHOWN = 100
# The file itself is UTF-8, so that only an escape can stand for half of a surrogate pair.
_SURROGATE = re.compile(r"\\u[dD][89a-fA-F]")


def atomic_write(
    path: str | os.PathLike[str], data: bytes | str, *, overwrite: bool = True, flag: str = ""
) -> Path:
    """Write a file so that a reader sees the old content or the new one, never a part."""
    path = Path(path)
    refuse_special(path)
    raw = data.encode() if isinstance(data, str) else data
    temporary: Path | None = None
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        temporary = temporary_name(path)
        # Not by tempfile, whose files are private: a result has the mode that the umask gives.
        with open(temporary, "xb") as stream:
            stream.write(raw)
        _name_file(temporary, path, overwrite)
    except BaseException as error:
        if temporary is not None:
            with contextlib.suppress(OSError):
                os.unlink(temporary)
        if not isinstance(error, OSError):
            raise
        if isinstance(error, FileExistsError) and not overwrite:
            raise _exists(path, flag) from error
        raise HwpError(
            f"cannot be written ({reason_of(error)})", where=path, remedy=_room(path)
        ) from error
    return path


def refuse_special(path: Path) -> None:
    """Refuse a device or a pipe as an output: whole files are renamed over what is there."""
    with contextlib.suppress(OSError):
        mode = path.stat().st_mode
        # What lies there may lead to a file, as /dev/stdout does.
        system = path.absolute().parent == Path("/dev")
        if system or not (stat.S_ISREG(mode) or stat.S_ISDIR(mode)):
            raise UsageError("is a device or a pipe", where=path, remedy="Name a file.")


def _refuse_mounted(path: Path) -> None:
    if os.path.ismount(os.path.realpath(path)):
        raise _mounted(path)


def _mounted(path: Path) -> UsageError:
    return UsageError(
        "is a mounted disc or volume, which no folder can replace",
        where=path,
        remedy="Name a folder inside of it.",
    )


def _room(path: Path) -> str:
    """Return the remedy for a place that cannot be written."""
    remedy = "Check the free space and the permissions of the folder"
    with contextlib.suppress(HwpError):
        if path.absolute().is_relative_to(cache_root().absolute()):
            remedy += ", or choose another cache folder with HWP_CACHE"
    return f"{remedy}."


def _name_file(temporary: Path, path: Path, overwrite: bool) -> None:
    """Give a written file its name; the system decides in one step whether the name is free."""
    if not overwrite:
        try:
            os.link(temporary, path)
        except FileExistsError:
            raise
        except OSError:
            # A file system without links: the name is taken first, and filled in the next step.
            os.close(os.open(path, os.O_CREAT | os.O_EXCL | os.O_WRONLY))
        else:
            os.unlink(temporary)
            return
    try:
        os.replace(temporary, path)
    except OSError:
        if not overwrite:
            os.unlink(path)
        raise


@contextlib.contextmanager
def disc_errors(where: str | os.PathLike[str]) -> Iterator[None]:
    """Turn the system's errors of a full or closed disc into one error that names the place.

    For work whose finished parts stay, so that the same call continues. Every other `OSError`, such
    as that of a closed pipe, passes.
    """
    try:
        yield
    except OSError as error:
        if error.errno not in _DISC:
            raise
        raise HwpError(
            f"cannot be written ({reason_of(error)})",
            where=where,
            remedy="Make room or check the permissions, and start again with the same arguments: "
            "what is finished stays.",
        ) from error


def refuse_existing(
    path: str | os.PathLike[str], *, overwrite: bool = False, flag: str = ""
) -> None:
    """Refuse to make a folder where something is; `flag` is the option that replaces it."""
    path = Path(path)
    _refuse_mounted(path)
    if path.is_file():
        raise _exists(path, "")  # A folder does not replace a file.
    if path.is_dir() and any(path.iterdir()) and not overwrite:
        raise _exists(path, flag)


def refuse_existing_file(
    path: str | os.PathLike[str], *, overwrite: bool, field: str | None = None
) -> None:
    """Refuse to replace a file of a person who has not given --overwrite; `field` names it."""
    if Path(path).exists() and not overwrite:
        remedy = "Choose another name, or give --overwrite."
        raise UsageError("exists", where=path, field=field, remedy=remedy)


def refuse_other(path: str | os.PathLike[str], what: str, is_one: Callable[[Path], bool]) -> None:
    """Refuse to put a folder in the place of a file, or of a folder with something else.

    An option that replaces would delete what nobody can make again.

    Args:
        what: what the folder is, in the words of the message.
        is_one: whether a folder that is not empty is one.
    """
    path = Path(path)
    _refuse_mounted(path)
    if path.is_file():
        raise UsageError("is a file", where=path, remedy="Name a folder.")
    if path.is_dir() and any(path.iterdir()) and not is_one(path):
        raise UsageError(
            f"is a folder with something else than {what}",
            where=path,
            remedy="Choose another name, or delete it.",
        )


def check_places(
    outputs: Mapping[str, Places],
    inputs: Mapping[str, Places],
    *,
    replaces: bool = False,
    makes_captures: bool = False,
) -> None:
    """Refuse outputs that would destroy or mix with each other or an input, before work begins."""
    made = _resolved(outputs)
    read = _resolved(inputs)
    for number, (option, path) in enumerate(made):
        others = made[:number] + made[number + 1 :]
        problem = _clash(path, others, "output", "what is made for it would be lost")
        problem = problem or _clash(path, read, "input", "an input is not changed")
        if not problem and replaces:
            held = [name for name, other in read if other.is_relative_to(path)]
            problem = f"holds the input {held[0]}, and would be replaced" if held else ""
        if not problem:
            within = path.parents if makes_captures else (path, *path.parents)
            capture = next((one for one in within if (one / _CAPTURE).is_file()), None)
            place = "is a capture" if capture == path else f"lies in the capture {capture}"
            problem = f"{place}, in which nothing else is written" if capture else ""
        if problem:
            raise UsageError(problem, where=path, field=option, remedy="Choose another place.")


def _resolved(places: Mapping[str, Places]) -> list[tuple[str, Path]]:
    found = []
    for option, value in places.items():
        several = [value] if isinstance(value, str | os.PathLike) else value or ()
        found += [(option, Path(path).resolve()) for path in several]
    return found


def _clash(path: Path, others: Sequence[tuple[str, Path]], kind: str, why: str) -> str:
    for option, other in others:
        if path == other:
            return f"is the {kind} {option} too: {why}"
        if path.is_relative_to(other):
            return f"lies in the {kind} {option} ({other}): {why}"
    return ""


def _exists(path: Path, flag: str) -> UsageError:
    another = f", or replace it with {flag}" if flag else ""
    return UsageError("exists already", where=path, remedy=f"Choose another place{another}.")


@contextlib.contextmanager
def atomic_folder(
    path: str | os.PathLike[str], *, overwrite: bool = False, flag: str = ""
) -> Iterator[Path]:
    """Fill a folder under a temporary name; it takes its own name only when the block ends well."""
    path = Path(path).absolute()
    if path.is_symlink():
        # What it leads to takes the content; the link stays.
        path = path.resolve()
    refuse_existing(path, overwrite=overwrite, flag=flag)
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        temporary = temporary_name(path)
        temporary.mkdir()
    except OSError as error:
        raise HwpError(f"cannot be made ({reason_of(error)})", where=path) from error
    try:
        yield temporary
        _take_name(temporary, path, overwrite, flag)
    except OSError as error:
        shutil.rmtree(temporary, ignore_errors=True)
        raise HwpError(
            f"cannot be written ({reason_of(error)})", where=path, remedy=_room(path)
        ) from error
    except BaseException:
        shutil.rmtree(temporary, ignore_errors=True)
        raise


def _take_name(temporary: Path, path: Path, overwrite: bool, flag: str) -> None:
    """Give a filled folder its name; the system decides in one step whether the name is free.

    Renaming a folder replaces an empty folder, and is refused where a file or a filled folder is.
    To look first and to rename then would lose what another process makes in between.
    """
    retired: list[Path] = []
    try:
        while True:
            try:
                os.rename(temporary, path)
                return
            except OSError as error:
                if error.errno in (errno.EBUSY, errno.EXDEV):  # mounted from the same file system
                    raise _mounted(path) from error
                if error.errno not in (errno.ENOTEMPTY, errno.EEXIST, errno.ENOTDIR):
                    raise
                if not overwrite or not path.is_dir() or len(retired) >= _MOST_RETIRED:
                    raise _exists(path, flag) from error
            aside = temporary.with_name(f"{temporary.name}.{len(retired)}.old")
            # Another process that replaces it too may have been faster.
            with contextlib.suppress(FileNotFoundError):
                os.rename(path, aside)
                retired.append(aside)
    except BaseException:
        # The last that had the name gets it back, or stays aside where somebody else has taken it.
        if retired:
            with contextlib.suppress(OSError):
                os.rename(retired.pop(), path)
        raise
    finally:
        for folder in retired:
            shutil.rmtree(folder, ignore_errors=True)


def temporary_name(path: Path) -> Path:
    """Return a name next to a path that nothing has; what it names is made with `x` or `mkdir`."""
    return path.with_name(f".{path.name[:200]}.{secrets.token_hex(6)}")


def canonical_json(value: Any) -> str:
    """Return the canonical format of a JSON value: sorted keys, no spaces, NaN refused."""
    return json.dumps(value, sort_keys=True, separators=(",", ":"), allow_nan=False)


def sha256_json(value: Any) -> str:
    """Return the SHA-256 (hex) of a JSON value's canonical format."""
    return hashlib.sha256(canonical_json(value).encode()).hexdigest()


def sha256_file(path: str | os.PathLike[str]) -> str:
    """Return the SHA-256 (hex) of a file's bytes."""
    with open(path, "rb") as stream:
        return hashlib.file_digest(stream, "sha256").hexdigest()


def check_is_file(
    path: Path,
    *,
    field: str | None = None,
    remedy: str | None = None,
    error: type[BadInput] = BadInput,
) -> None:
    """Refuse all but a regular file, before something waits for a pipe or reads a device."""

    def refuse(problem: str) -> BadInput:
        return error(problem, where=path, field=field, remedy=remedy)

    try:
        mode = path.stat().st_mode
    except (FileNotFoundError, NotADirectoryError) as missing:
        raise refuse("does not exist") from missing
    except (OSError, ValueError) as failure:
        reason = getattr(failure, "strerror", None) or "its name cannot be used"
        raise refuse(f"cannot be read ({reason})") from failure
    if not stat.S_ISREG(mode):
        kinds = ((stat.S_ISDIR, "a folder"), (stat.S_ISFIFO, "a pipe"), (stat.S_ISSOCK, "a socket"))
        kind = next((name for test, name in kinds if test(mode)), "a device")
        raise refuse(f"is {kind} where a file is expected")


def sha256_of(path: Path) -> str:
    """Return the SHA-256 (hex) of a file, read again only when its size or date has changed."""
    facts = path.stat()
    return _sha256(path, facts.st_size, facts.st_mtime_ns)


@lru_cache(maxsize=1 << 17)
def _sha256(path: Path, size: int, modified: int) -> str:
    return sha256_file(path)


def files_digest(root: Path, paths: Iterable[Path]) -> str:
    """Return the SHA-256 (hex) of files: their names below `root`, and their contents."""
    total = hashlib.sha256()
    for path in sorted(paths):
        total.update(f"{path.relative_to(root).as_posix()}\0".encode())
        total.update(bytes.fromhex(sha256_of(path)))
    return total.hexdigest()


def read_json(path: str | os.PathLike[str], *, max_bytes: int = MAX_JSON_BYTES) -> Any:
    """Read a JSON file from outside."""
    path = Path(path)
    try:
        text = read_bounded(path, max_bytes).decode()
        value = json.loads(
            text,
            parse_constant=_finite,
            parse_float=_finite,
            parse_int=_bounded_int,
            object_pairs_hook=_table,
        )
        for _ in inner_values(value, MAX_JSON_DEPTH):
            pass
    except FileNotFoundError as error:
        raise BadInput("does not exist", where=path) from error
    except OSError as error:
        raise BadInput(f"cannot be read ({reason_of(error)})", where=path) from error
    except UnicodeDecodeError as error:
        raise BadInput("is not UTF-8 text", where=path) from error
    except RecursionError as error:
        raise BadInput("is nested too deeply", where=path) from error
    except _RepeatedKey as error:
        raise BadInput(
            f"names {shown(error.args[0])[:_SHOWN]!r} twice in one object",
            where=path,
            remedy="Readers of JSON disagree on which value counts; keep one of them.",
        ) from error
    except ValueError as error:
        raise BadInput(f"is not valid JSON ({error})", where=path) from error
    if _SURROGATE.search(text) and not is_unicode(json.dumps(value, ensure_ascii=False)):
        raise BadInput(
            "holds text that is not Unicode (half of a surrogate pair)",
            where=path,
            remedy="Look for an escape from \\ud800 to \\udfff that stands alone.",
        )
    return value


def read_bounded(path: Path, max_bytes: int) -> bytes:
    """Read a regular file from outside that holds at most so many bytes."""
    # Non-blocking: a named pipe would keep its reader waiting forever. The size of a device or a
    # growing file does not say how much can be read from it.
    handle = os.open(path, os.O_RDONLY | getattr(os, "O_NONBLOCK", 0))
    with os.fdopen(handle, "rb") as stream:
        if not stat.S_ISREG(os.fstat(stream.fileno()).st_mode):
            raise BadInput("is not a regular file", where=path)
        data = stream.read(max_bytes + 1)
    if len(data) > max_bytes:
        raise BadInput(f"holds more than the {max_bytes} bytes that are read", where=path)
    return data


def inner_values(value: Any, most: int) -> Iterator[Any]:
    """Every value inside of lists and tables, level by level.

    Raises:
        RecursionError: there are more than `most` levels.
    """
    level = [value] if isinstance(value, dict | list) else []
    for _ in range(most):
        level = [
            item
            for holder in level
            for item in (holder.values() if isinstance(holder, dict) else holder)
        ]
        yield from level
        level = [item for item in level if isinstance(item, dict | list)]
        if not level:
            return
    raise RecursionError


class _RepeatedKey(ValueError):
    """An object names a key twice; the argument is the key."""


def _table(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    table: dict[str, Any] = {}
    for name, value in pairs:
        if name in table:
            raise _RepeatedKey(name)
        table[name] = value
    return table


def _finite(text: str) -> float:
    number = float(text)
    if not math.isfinite(number):
        what = "too large a number" if text[-1].isdigit() else "not a JSON number"
        raise ValueError(f"{text[:20]} is {what}")
    return number


def _bounded_int(text: str) -> int:
    # Long ones are recognised by their length: converting them takes long.
    if len(text) > 20 or abs(int(text)) > MAX_JSON_INTEGER:
        raise ValueError(f"{text[:20]}... is too large a number")
    return int(text)


def write_json(path: str | os.PathLike[str], value: Any) -> Path:
    """Write a JSON file atomically, indented, keys in the order given, NaN refused."""
    return atomic_write(path, json.dumps(value, indent=1, allow_nan=False) + "\n")


def inside(root: str | os.PathLike[str], relative: str) -> Path:
    """Join a path from outside to a folder, refusing whatever leads out of the folder."""
    base = Path(root).resolve()
    if "\0" in relative:
        said = f"the path {relative[:80]!r} holds a zero character"
        raise BadInput(said, where=root, remedy="Use the name of a file.")
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
    try:
        if "HWP_CACHE" in os.environ:
            return Path(os.environ["HWP_CACHE"]).expanduser()
        base = os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache"
    except RuntimeError as error:
        raise HwpError(
            "the user has no home folder", remedy="Name a folder for the cache in HWP_CACHE."
        ) from error
    return Path(base) / "hwp-bench"
