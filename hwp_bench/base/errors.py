"""The one root of every error that the toolkit raises on purpose.

A message says what is wrong, in which file and field, and what to do about it. The command
line prints `str(error)` on one line and leaves with `error.exit_status`; any other exception
that reaches a user is a bug of ours.
"""

from __future__ import annotations

import os
from typing import ClassVar


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
        super().__init__(self._message())

    def _message(self) -> str:
        parts = [part for part in (self.where, self.field) if part]
        head = ": ".join([*parts, self.problem])
        return f"{head}. {self.remedy}" if self.remedy else head


def reason_of(error: OSError) -> str:
    """Return what the system says of a file or folder that it refuses."""
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
    """A file from outside is missing, damaged or does not say what it must."""


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
