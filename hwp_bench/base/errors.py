"""The one root of every error that the toolkit raises on purpose, its words, and checked arguments.

A message says what is wrong, in which file and field, and what to do about it. The command
line prints `str(error)` on one line and leaves with `error.exit_status`; any other exception
that reaches a user is a bug of ours.
"""

from __future__ import annotations

import contextlib
import difflib
import math
import numbers
import operator
import os
import re
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any, ClassVar


class HwpError(Exception):
    """Root of the toolkit's errors.

    Args:
        problem: what is wrong, in one sentence without the final full stop.
        where: the file, folder or option that is at fault.
        field: the key, array or argument inside `where`.
        remedy: what the person can do about it.
    """

    #: Exit status of the command line: 1 = the work failed, 2 = it was asked for wrongly.
    exit_status: ClassVar[int] = 1

    def __init__(
        self,
        problem: str,
        *,
        where: str | os.PathLike[str] | None = None,
        field: str | None = None,
        remedy: str | None = None,
    ) -> None:
        self.problem = problem
        self.where = None if where is None else os.fspath(where)
        self.field = field
        self.remedy = remedy
        head = ": ".join(part for part in (self.where, self.field, problem) if part)
        # A problem that another program has written may end with one.
        super().__init__(f"{head.removesuffix('.')}. {remedy}" if remedy else head)


def reason_of(error: OSError) -> str:
    """Return the system's reason for refusing a file or folder."""
    if error.strerror:
        return error.strerror
    first = error.args[0] if error.args else ""
    if isinstance(first, list) and first:
        # Of `shutil.copytree`: a source, a target and a text for each file.
        first = first[0][-1] if isinstance(first[0], tuple) else first[0]
    return str(first)[:300] or type(error).__name__


class UsageError(HwpError):
    """The command or function was called in a way that makes no sense."""

    exit_status = 2


class BadInput(HwpError):
    """A file from outside is missing, damaged or incomplete."""


class BadImage(BadInput):
    """An image is missing, empty, truncated, too large, or of the wrong size or type."""


class BadCapture(BadInput):
    """A capture folder breaks the capture format."""


class BadSplit(BadInput):
    """A split overlaps, leaves frames out, or does not belong to the capture."""


class BadHandModel(BadInput):
    """A hand model file or its parameters are unusable."""


class UnsafePickle(BadInput):
    """A pickle asks for something other than plain arrays and containers."""


class BadMethod(BadInput):
    """A method directory does not keep the method contract."""


class MethodFailed(HwpError):
    """A method crashed, hung, or wrote predictions that cannot be scored."""


class BadPrediction(BadInput):
    """One predicted frame is missing, unreadable, not finite, or of the wrong size or type."""


class BadResult(BadInput):
    """A result file breaks the result schema."""


class ShapeMismatch(HwpError):
    """Arrays that must describe the same thing have different shapes."""


class EmptyMask(HwpError):
    """A mask leaves no pixel to work on."""


class MissingDependency(HwpError):
    """An optional package or file is needed here and not installed."""


class DidNotConverge(HwpError):
    """An optimization left the range of finite or sensible values."""


#: Control characters except tab and line feed, the marks that reverse the direction of writing,
#: and halves of surrogate pairs, which no file can hold as UTF-8; as a set of characters in a
#: regular expression (without its brackets).
ODD_CHARACTERS = r"\x00-\x08\x0b-\x1f\x7f-\x9f\u202a-\u202e\u2066-\u2069\ud800-\udfff"
_ODD = re.compile(f"[{ODD_CHARACTERS}]")


def bounded(items: Sequence[object], most: int = 12) -> str:
    """Return items separated by commas, at most some of them, and how many more there are."""
    text = ", ".join(str(item) for item in items[:most])
    return text if len(items) <= most else f"{text} and {len(items) - most} more"


def nearest(wrong: str, known: Iterable[str], *, most: int = 1, cutoff: float = 0.6) -> list[str]:
    """Return the known names that are most like a wrong one, the closest first; often none."""
    return difflib.get_close_matches(wrong[:200], list(known), n=most, cutoff=cutoff)


def did_you_mean(wrong: str, known: Iterable[str]) -> str:
    """Return `Did you mean 'NAME'?` of the nearest known name; empty where none is near."""
    near = nearest(wrong, known)
    return f"Did you mean {near[0]!r}?" if near else ""


def has_odd_characters(text: str) -> bool:
    """Whether a text holds one of `ODD_CHARACTERS`."""
    return _ODD.search(text) is not None


def is_unicode(text: str) -> bool:
    """Whether a text can be written as UTF-8: it holds no half of a surrogate pair."""
    try:
        text.encode()
    except UnicodeEncodeError:
        return False
    return True


def check_name(path: str | os.PathLike[str]) -> None:
    """Refuse the name of a file or folder that is not UTF-8.

    Libraries that read and write files in C++ take such a name for another one.
    """
    text = os.fspath(path)
    if not is_unicode(text):
        raise UsageError("is not UTF-8", where=shown(text), remedy="Rename the file or folder.")


def shown(text: str) -> str:
    """Return a text that can be printed on a terminal: odd characters become `?`."""
    return _ODD.sub("?", text)


def one_line(text: str, most: int = 1000) -> str:
    """Return a text as a record keeps it: one line without odd characters, of bounded length."""
    return shown(text[:most]).replace("\n", " ")


def whole_number(value: Any, field: str) -> int:
    """Return an integer of Python or NumPy as Python's."""
    with contextlib.suppress(TypeError):
        if not isinstance(value, bool):
            return operator.index(value)
    raise _wrong(value, field, "an integer")


def real_number(value: Any, field: str) -> float:
    """Return a finite number of Python or NumPy as Python's."""
    with contextlib.suppress(OverflowError):
        real = isinstance(value, numbers.Real) and not isinstance(value, bool)
        if real and math.isfinite(number := float(value)):
            return number
    raise _wrong(value, field, "a finite number")


def place(value: Any, field: str) -> Path:
    """Return a path that is given as text or as a path."""
    if isinstance(value, str | os.PathLike):
        text = os.fspath(value)
        if isinstance(text, str) and text and "\0" not in text:
            return Path(text)
    raise _wrong(value, field, "a path")


def of_type(value: Any, kinds: type | tuple[type, ...], field: str, expected: str) -> Any:
    """Return an argument that is of one of some types."""
    if isinstance(value, kinds):
        return value
    raise _wrong(value, field, expected)


def _wrong(value: Any, field: str, expected: str) -> UsageError:
    plain = value is None or isinstance(value, str | bytes | int | float)
    text = repr(value)[:60] if plain else ""
    given = f"{shown(text)} ({type(value).__name__})" if text else f"a {type(value).__name__}"
    return UsageError(f"is {given}, not {expected}", field=field)
