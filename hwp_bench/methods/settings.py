"""Settings of a method as a dataclass, checked when they are read.

For authors of methods: `settings_from(MySettings, table)` turns a preset's table, with what the
command line overrides, into a frozen dataclass, or says which name or value is wrong.
"""

from __future__ import annotations

import dataclasses
import difflib
import math
import os
import types
import typing
from collections.abc import Mapping
from typing import Any, TypeVar

from hwp_bench.base.errors import BadMethod, HwpError
from hwp_bench.base.files import MAX_JSON_INTEGER

#: Deepest table in a table that is read.
MAX_DEPTH = 16

Settings = TypeVar("Settings")

#: Longest piece of a name or value that is repeated in a message.
_SHOWN = 100


def number(default: float, low: float = 0.0, high: float = math.inf) -> Any:
    """A dataclass field for a number within [low, high]."""
    return dataclasses.field(default=default, metadata={"range": (low, high)})


def choice(default: str, *others: str) -> Any:
    """A dataclass field for one of several words."""
    return dataclasses.field(default=default, metadata={"choices": (default, *others)})


def settings_from(cls: type[Settings], values: Mapping[str, Any], where: str) -> Settings:
    """Check a table of settings.

    A field that is itself a dataclass reads a table of its own; `name.field` reaches into it,
    and so does `--set name.field=value`.

    Args:
        cls: a dataclass whose fields are bool, int, float, str, Literal, or such dataclasses,
            each with a default; numbers may be bounded by `number`, words by `choice`. An
            unbounded number must not be negative.
        values: any of its fields; later entries win over earlier ones.
        where: what messages call the place, such as the method's folder.

    Raises:
        BadMethod: an unknown name (the message says which one is close), a wrong type, or a
            value outside its range.
    """
    return _read(cls, _unfold(values), where, "")


def _unfold(values: Mapping[str, Any]) -> dict[str, Any]:
    """Turn `a.b` into tables, and merge tables that are named twice."""
    tree: dict[str, Any] = {}
    for name, value in values.items():
        head, dot, rest = str(name).partition(".")
        if dot:
            value = {rest: value}
        if isinstance(value, Mapping):
            before = tree.get(head)
            merged = {**before, **value} if isinstance(before, dict) else dict(value)
            tree[head] = _unfold(merged)
        else:
            tree[head] = value
    return tree


def _read(cls: type[Settings], values: Mapping[str, Any], where: str, prefix: str) -> Settings:
    items = {item.name: item for item in dataclasses.fields(cls)}  # type: ignore[arg-type]
    kinds = typing.get_type_hints(cls)
    checked: dict[str, Any] = {}
    for name, value in values.items():
        field = f"{prefix}{name}"[:_SHOWN]
        if name not in items:
            close = difflib.get_close_matches(name, items, n=1)
            raise BadMethod(
                "is not a setting of this method",
                where=where,
                field=field,
                remedy=f"Did you mean {prefix + close[0]!r}?" if close else f"Known: {[*items]}.",
            )
        kind = kinds[name]
        if dataclasses.is_dataclass(kind):
            if not isinstance(value, Mapping):
                raise BadMethod("must be a table", where=where, field=field)
            checked[name] = _read(typing.cast("type[Any]", kind), value, where, f"{field}.")
        else:
            checked[name] = _checked(value, kind, items[name].metadata, where, field)
    try:
        return cls(**checked)
    except HwpError as error:
        raise BadMethod(str(error), where=where, field=prefix.rstrip(".")) from error


def _checked(value: Any, kind: Any, rules: Mapping[str, Any], where: str, field: str) -> Any:
    def bad(remedy: str) -> BadMethod:
        return BadMethod(f"is {str(value)[:_SHOWN]!r}", where=where, field=field, remedy=remedy)

    choices = rules.get("choices")
    if typing.get_origin(kind) is typing.Literal:
        kind, choices = str, typing.get_args(kind)
    if isinstance(kind, types.UnionType):  # X | None
        if value is None:
            return None
        kind = next(part for part in kind.__args__ if part is not type(None))
    if kind is bool:
        if not isinstance(value, bool):
            raise bad("Use true or false.")
        return value
    if kind is str:
        if not isinstance(value, str) or (choices and value not in choices):
            raise bad(f"Use one of {', '.join(choices)}." if choices else "Use text.")
        return value
    numbers = (int,) if kind is int else (int, float)
    if isinstance(value, bool) or not isinstance(value, numbers):
        raise bad("Use an integer." if kind is int else "Use a number.")
    low, high = rules.get("range", (0.0, math.inf))
    if not low <= value <= high or not math.isfinite(value):
        raise bad(f"Use {low:g} to {high:g}.")
    return value if kind is int else float(value)


def check_plain(
    value: Any, where: str | os.PathLike[str], field: str, *, depth: int = MAX_DEPTH
) -> None:
    """Refuse a value that JSON cannot hold: settings are plain values, so that they have a digest.

    Args:
        value: finite numbers, text, true and false, and lists and tables of these.
        where: the file, for messages.
        field: its place in the file, for messages.
        depth: levels of tables that may still follow.

    Raises:
        BadMethod: there is a date, an infinite, undefined or very large number, or too deep
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
            raise BadMethod(f"is {value}, not a finite number", where=where, field=field[:100])
    elif isinstance(value, int):
        if abs(value) > MAX_JSON_INTEGER:
            raise BadMethod("is too large a number", where=where, field=field[:100])
    elif not isinstance(value, str):
        problem = f"is a {type(value).__name__}, not a number, text, list or table"
        raise BadMethod(problem, where=where, field=field[:100])
