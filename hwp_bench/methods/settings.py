"""Settings of a method as a dataclass, checked when they are read.

For authors of methods: `settings_from(MySettings, table)` turns a preset's table, with the
overrides of the command line, into a frozen dataclass, or says which name or value is wrong.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any, TypeVar

from hwp_bench.base.errors import BadMethod, UsageError
from hwp_bench.base.records import choice, number, parse_record, unfold

__all__ = ["check_source", "choice", "number", "settings_from", "source_path"]

Settings = TypeVar("Settings")


def settings_from(cls: type[Settings], values: Mapping[str, Any], where: str) -> Settings:
    """Check a table of settings.

    A field that is itself a dataclass reads a table of its own; `name.field` reaches into it,
    and so does `--set name.field=value`.

    Args:
        cls: a dataclass whose fields are bool, int, float, str, Literal, or such dataclasses,
            each with a default; numbers may be bounded by `number`, words by `choice`. An
            unbounded number must not be negative.
        values: any of its fields; later entries win over earlier ones.
        where: name of the place in messages, such as the method's folder.

    Raises:
        BadMethod: an unknown name (the message says which one is close), a wrong type, or a
            value outside its range.
    """
    return parse_record(cls, unfold(values), where=where, error=BadMethod, numbers=(0.0, math.inf))


def check_source(value: str, field: str, words: Sequence[str], kinds: Sequence[str]) -> None:
    """Refuse a setting that is neither one of some words nor `KIND:PATH`.

    Args:
        value: of the setting.
        field: its name, for the message.
        words: those that stand for themselves.
        kinds: of files that a person brings; `files` in `method.toml` lists them too.

    Raises:
        UsageError: it is something else.
    """
    kind, colon, place = value.partition(":")
    if value in words or (colon and place and kind in kinds):
        return
    known = [*words, *(f"{kind}:PATH" for kind in kinds)]
    raise UsageError(f"is {value[:100]!r}", field=field, remedy=f"Use {' or '.join(known)}.")


def source_path(value: str) -> str | None:
    """Return the path in a setting's value `KIND:PATH`; None where it is a word."""
    _, colon, place = value.partition(":")
    return place if colon else None
