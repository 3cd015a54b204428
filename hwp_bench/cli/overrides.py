"""`--set NAME=VALUE`, wherever a command takes settings."""

from __future__ import annotations

import tomllib
from collections.abc import Iterable
from typing import Any

from hwp_bench.base.errors import UsageError


def overrides(texts: Iterable[str]) -> dict[str, Any]:
    """Read texts of the form `NAME=VALUE`.

    Args:
        texts: a name, or `name.field` for a field of a table, and a value as TOML writes it; a
            value that is not TOML is text, so that words need no quotation marks. The last value
            of a name wins.

    Raises:
        UsageError: a text is not of this form.
    """
    found = {}
    for text in texts:
        name, equals, value = text.partition("=")
        if not equals or not all(part.isidentifier() for part in name.split(".")):
            raise UsageError(f"{text!r} is not NAME=VALUE", field="--set")
        try:
            found[name] = tomllib.loads(f"value = {value}")["value"]
        except tomllib.TOMLDecodeError:
            found[name] = value
    return found
