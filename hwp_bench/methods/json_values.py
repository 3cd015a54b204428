"""Settings of methods are plain values: what JSON can spell, so that a digest of them exists."""

from __future__ import annotations

import math
import os
from typing import Any

from hwp_bench.base.errors import BadMethod
from hwp_bench.base.files import MAX_JSON_INTEGER

#: Deepest table in a table that is read.
MAX_DEPTH = 16


def check_plain(
    value: Any, where: str | os.PathLike[str], field: str, *, depth: int = MAX_DEPTH
) -> None:
    """Refuse values that are no finite number, text, truth value, or list or table of such.

    Raises:
        BadMethod: there is a date, an infinite, undefined or absurdly large number, or too deep
            a nesting; the field is named.
    """
    if depth == 0:
        raise BadMethod("is nested too deeply", where=where, field=field[:100])
    if isinstance(value, dict):
        for name, item in value.items():
            check_plain(item, where, f"{field}.{name}", depth=depth - 1)
    elif isinstance(value, list):
        for item in value:
            check_plain(item, where, field, depth=depth - 1)
    elif isinstance(value, float):
        if not math.isfinite(value):
            raise BadMethod(f"is {value}, no finite number", where=where, field=field[:100])
    elif isinstance(value, int):
        if abs(value) > MAX_JSON_INTEGER:
            raise BadMethod("is too large a number", where=where, field=field[:100])
    elif not isinstance(value, str):
        problem = f"is a {type(value).__name__}, neither number, text, list nor table"
        raise BadMethod(problem, where=where, field=field[:100])
