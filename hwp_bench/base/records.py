"""Frozen dataclasses from untrusted JSON, checked by their annotations."""

from __future__ import annotations

import math
from dataclasses import MISSING, fields
from types import UnionType
from typing import Any, TypeVar, get_args, get_origin, get_type_hints

from hwp_bench.base.errors import BadResult
from hwp_bench.base.text import has_odd_characters, shown

Record = TypeVar("Record")


def parse_record(kind: type[Record], value: Any, *, where: str, field: str = "") -> Record:
    """Make a dataclass out of JSON, checking every field by its annotation.

    Args:
        kind: a dataclass of str, int, float, bool, Any, dict, list, further dataclasses, and
            unions of one of them with None.
        value: what the file holds.
        where: the file, for the message.
        field: path of `value` in the file, ending in a full stop.

    Returns:
        The record; fields that are missing have their default, where there is one.

    Raises:
        BadResult: a field is missing, unknown, of the wrong type, not finite, or holds a
            control character; it is named.
    """
    if not isinstance(value, dict):
        raise BadResult("must be a JSON object", where=where, field=field.rstrip(".") or None)
    hints = get_type_hints(kind)
    listed = fields(kind)  # type: ignore[arg-type]
    names = {item.name for item in listed}
    spared = {i.name for i in listed if (i.default, i.default_factory) != (MISSING, MISSING)}
    for name in sorted((names ^ value.keys()) - (spared - value.keys())):
        problem = "is missing" if name in names else "is not known"
        raise BadResult(problem, where=where, field=f"{field}{name}")
    converted = {
        name: _convert(hints[name], item, where, f"{field}{name}") for name, item in value.items()
    }
    return kind(**converted)


def _convert(hint: Any, value: Any, where: str, field: str) -> Any:
    origin, arguments = get_origin(hint), get_args(hint)
    if origin is UnionType:
        if value is None and type(None) in arguments:
            return None
        return _convert(arguments[0], value, where, field)
    if origin is list:
        if isinstance(value, list):
            return [
                _convert(arguments[0], item, where, f"{field}[{index}].")
                for index, item in enumerate(value)
            ]
    elif origin is dict:
        if isinstance(value, dict):
            if any(has_odd_characters(key) for key in value):
                raise BadResult("holds a control character in a name", where=where, field=field)
            return {
                key: _convert(arguments[1], item, where, f"{field}.{key}")
                for key, item in value.items()
            }
    elif hint is Any:
        return value
    elif hint is float:
        if isinstance(value, int | float) and not isinstance(value, bool) and math.isfinite(value):
            return float(value)
    elif hint in (int, str, bool):
        if isinstance(value, str) and has_odd_characters(value):
            raise BadResult("holds a control character", where=where, field=shown(field))
        if isinstance(value, hint) and not (hint is int and isinstance(value, bool)):
            return value
    else:
        prefix = field if field.endswith(".") else f"{field}."
        return parse_record(hint, value, where=where, field=prefix)
    raise BadResult(f"is {str(value)[:60]!r}, of the wrong type", where=where, field=field)
