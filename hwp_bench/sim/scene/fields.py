"""Reading a table from outside field by field, with errors that name the field."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

from hwp_bench.base.errors import BadInput


class Fields:
    """A table whose fields are taken one by one; `finish` refuses what nobody took.

    Args:
        content: the table.
        where: the file, for messages.
        prefix: the path of this table inside the file.
    """

    def __init__(self, content: Mapping[str, Any], where: str, prefix: str = "") -> None:
        self.where = where
        self._prefix = prefix
        self._content = dict(content)

    def name(self, key: str) -> str:
        """Return the full name of a field."""
        return f"{self._prefix}{key}"

    def wrong(self, key: str, problem: str, remedy: str | None = None) -> BadInput:
        """Return the error that says what is wrong with a field."""
        return BadInput(problem, where=self.where, field=self.name(key), remedy=remedy)

    def _take(self, key: str, default: Any = None) -> Any:
        if key in self._content:
            return self._content.pop(key)
        if default is None:
            raise self.wrong(key, "is missing")
        return default

    def text(self, key: str, default: str | None = None) -> str:
        """Take a text that is not empty."""
        value = self._take(key, default)
        if not isinstance(value, str) or not value.strip():
            raise self.wrong(key, f"is {value!r}, expected text")
        return value

    def choice(self, key: str, known: Sequence[str], default: str | None = None) -> str:
        """Take one of the known texts."""
        value = self.text(key, default)
        if value not in known:
            raise self.wrong(key, f"is {value!r}", remedy=f"Known: {', '.join(known)}.")
        return value

    def number(self, key: str, low: float, high: float, default: float | None = None) -> float:
        """Take a finite number within bounds."""
        value = self._take(key, default)
        if isinstance(value, bool) or not isinstance(value, int | float):
            raise self.wrong(key, f"is {value!r}, expected a number")
        if not math.isfinite(value) or not low <= value <= high:
            raise self.wrong(key, f"is {value}, expected {low:g} to {high:g}")
        return float(value)

    def whole(self, key: str, low: int, high: int, default: int | None = None) -> int:
        """Take a whole number within bounds."""
        value = self._take(key, default)
        if isinstance(value, bool) or not isinstance(value, int):
            raise self.wrong(key, f"is {value!r}, expected a whole number")
        if not low <= value <= high:
            raise self.wrong(key, f"is {value}, expected {low} to {high}")
        return value

    def flag(self, key: str) -> bool:
        """Take true or false."""
        value = self._take(key)
        if not isinstance(value, bool):
            raise self.wrong(key, f"is {value!r}, expected true or false")
        return value

    def vector(
        self, key: str, limit: float, default: tuple[float, float, float] | None = None
    ) -> tuple[float, float, float]:
        """Take three finite numbers of absolute value `limit` at most."""
        x, y, z = self._numbers(key, self._take(key, default), 3)
        if max(abs(x), abs(y), abs(z)) > limit:
            raise self.wrong(key, f"goes beyond {limit:g}")
        return x, y, z

    def triples(self, key: str) -> list[tuple[float, float, float]]:
        """Take a list of rows of three finite numbers, at least one."""
        rows = self._take(key)
        if not isinstance(rows, list) or not rows:
            raise self.wrong(key, "is no list of rows")
        triples = []
        for row in rows:
            a, b, c = self._numbers(key, row, 3)
            triples.append((a, b, c))
        return triples

    def rising(self, key: str, count: int) -> tuple[float, ...] | None:
        """Take `count` numbers from 0 up, none below the one before; None where absent."""
        if key not in self._content:
            return None
        values = self._numbers(key, self._take(key), count)
        if values[0] < 0.0 or sorted(values) != values:
            raise self.wrong(key, f"is {values}, expected rising numbers from 0 up")
        return tuple(values)

    def _numbers(self, key: str, value: Any, count: int) -> list[float]:
        good = isinstance(value, list | tuple) and len(value) == count
        if not good or not all(
            isinstance(item, int | float) and not isinstance(item, bool) and math.isfinite(item)
            for item in value
        ):
            raise self.wrong(key, f"is {value!r}, expected {count} numbers")
        return [float(item) for item in value]

    def table(self, key: str) -> Fields:
        """Take a table."""
        value = self._take(key)
        if not isinstance(value, dict):
            raise self.wrong(key, f"is {value!r}, expected a table")
        return Fields(value, self.where, f"{self.name(key)}.")

    def optional_table(self, key: str) -> Fields | None:
        """Take a table, or None where there is none."""
        return self.table(key) if key in self._content else None

    def rows(self, key: str) -> list[Fields]:
        """Take a list of tables; none where the field is absent."""
        value = self._content.pop(key, [])
        if not isinstance(value, list) or not all(isinstance(row, dict) for row in value):
            raise self.wrong(key, "is no list of tables")
        return [
            Fields(row, self.where, f"{self.name(key)}[{index}].")
            for index, row in enumerate(value)
        ]

    def rest(self) -> dict[str, Any]:
        """Take whatever is left."""
        rest, self._content = self._content, {}
        return rest

    def finish(self) -> None:
        """Refuse fields that nobody took.

        Raises:
            BadInput: it names the first of them.
        """
        for key in self._content:
            raise self.wrong(key, "is unknown", remedy="Check its spelling, or leave it out.")
