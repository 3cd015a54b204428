"""Arguments of public functions: of the right type, or one error that names them."""

from __future__ import annotations

import math
import numbers
import operator
import os
from pathlib import Path
from typing import Any

from hwp_bench.base.errors import UsageError
from hwp_bench.base.text import shown


def whole_number(value: Any, field: str) -> int:
    """Return an integer of Python or NumPy as Python's.

    Raises:
        UsageError: it is of another type, a boolean too.
    """
    if not isinstance(value, bool):
        try:
            return operator.index(value)
        except TypeError:
            pass
    raise _wrong(value, field, "an integer")


def real_number(value: Any, field: str) -> float:
    """Return a finite number of Python or NumPy as Python's.

    Raises:
        UsageError: it is of another type, a boolean too, or not finite.
    """
    if isinstance(value, numbers.Real) and not isinstance(value, bool):
        try:
            number = float(value)
        except OverflowError:
            number = math.inf
        if math.isfinite(number):
            return number
    raise _wrong(value, field, "a finite number")


def place(value: Any, field: str) -> Path:
    """Return a path that is given as text or as a path.

    Raises:
        UsageError: it is of another type, empty, or holds a zero byte.
    """
    if isinstance(value, str | os.PathLike):
        text = os.fspath(value)
        if isinstance(text, str) and text and "\0" not in text:
            return Path(text)
    raise _wrong(value, field, "a path")


def of_type(value: Any, kinds: type | tuple[type, ...], field: str, expected: str) -> Any:
    """Return an argument that is of one of some types.

    Args:
        value: the argument.
        kinds: the types.
        field: its name.
        expected: what these types are, for the message.

    Raises:
        UsageError: it is of another type.
    """
    if isinstance(value, kinds):
        return value
    raise _wrong(value, field, expected)


def _wrong(value: Any, field: str, expected: str) -> UsageError:
    plain = value is None or isinstance(value, str | bytes | int | float)
    text = repr(value)[:60] if plain else ""
    given = f"{shown(text)} ({type(value).__name__})" if text else f"a {type(value).__name__}"
    return UsageError(f"is {given}, not {expected}", field=field)
