"""`--set NAME=VALUE`, wherever a command takes settings."""

from __future__ import annotations

import tomllib
from collections.abc import Iterable, Mapping
from typing import Any

from hwp_bench.base.errors import UsageError, has_odd_characters, shown
from hwp_bench.base.records import parse_toml

# Deepest table that a dotted name leads to.
_MOST_TABLES = 8
# What begins a string, a list or a table.
_OPENING = frozenset("\"'[{")


def overrides(texts: Iterable[str]) -> dict[str, Any]:
    """Read texts of the form `NAME=VALUE`.

    Args:
        texts: a name, or `name.field` for a field of a table, and a value as TOML writes it; a
            value that is not TOML is text, so that words need no quotation marks. The last value
            of a name wins.

    Raises:
        UsageError: a text is not of this form, its value is too large, too deep or no Unicode, or
            begins as a list, table or string of TOML and is none; or one name is a value and a
            table.
    """
    found: dict[str, Any] = {}
    for text in texts:
        name, equals, value = text.partition("=")
        if not equals or not all(part.isidentifier() for part in name.split(".")):
            raise UsageError(f"{text[:100]!r} is not NAME=VALUE", field="--set")
        if name.count(".") > _MOST_TABLES:
            raise UsageError(f"{text[:100]!r} names too deep a table", field="--set")
        place = f"{name[:100]}={shown(value)[:40]}"
        try:
            content = parse_toml(f"value = {value}", where="--set", field=place, error=UsageError)
            found[name] = content["value"]
        except UsageError as error:
            # A word without quotation marks is text; what is TOML but out of bounds is not.
            if not isinstance(error.__cause__, tomllib.TOMLDecodeError):
                raise
            if value.lstrip()[:1] in _OPENING:
                problem = f"begins as TOML and is none ({error.__cause__})"
                remedy = "Close it; a text that begins so is written in quotation marks."
                raise UsageError(problem, where="--set", field=place, remedy=remedy) from error
            if has_odd_characters(value):
                problem = "holds a control character, or cannot be Unicode"
                raise UsageError(problem, where="--set", field=place) from error
            found[name] = value
    _check_tables(found)
    return found


def _check_tables(found: Mapping[str, Any]) -> None:
    """Refuse a name that is a value and, in another one, a table."""
    for name in found:
        parts = name.split(".")
        for count in range(1, len(parts)):
            above = ".".join(parts[:count])
            if not isinstance(found.get(above, {}), dict):
                problem = f"{above!r} is a value, and a table in {name!r}"
                raise UsageError(problem, field="--set", remedy="Give one of them.")
