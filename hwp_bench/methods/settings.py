"""Settings of a method as a dataclass, checked when they are read.

For authors of methods: `settings_from(MySettings, table)` turns a preset's table, with the
overrides of the command line, into a frozen dataclass, or says which name or value is wrong.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any, TypeVar

from hwp_bench.base.errors import BadMethod
from hwp_bench.base.records import choice, number, parse_record, unfold

__all__ = ["choice", "number", "settings_from"]

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
