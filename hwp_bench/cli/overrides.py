"""`--set NAME=VALUE`, wherever a command takes settings."""

from __future__ import annotations

import tomllib
from collections.abc import Iterable
from typing import Any

from hwp_bench.base.errors import UsageError
from hwp_bench.base.text import has_odd_characters, shown
from hwp_bench.base.toml_text import parse_toml

# Deepest table that a dotted name leads to.
_MOST_TABLES = 8


def overrides(texts: Iterable[str]) -> dict[str, Any]:
    """Read texts of the form `NAME=VALUE`.

    Args:
        texts: a name, or `name.field` for a field of a table, and a value as TOML writes it; a
            value that is not TOML is text, so that words need no quotation marks. The last value
            of a name wins.

    Raises:
        UsageError: a text is not of this form, or its value is too large, too deep or no Unicode.
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
            if has_odd_characters(value):
                problem = "holds a control character, or cannot be Unicode"
                raise UsageError(problem, where="--set", field=place) from error
            found[name] = value
    return found
