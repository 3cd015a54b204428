"""Settings in tables and tables of tables; the oracle is the dataclass built by hand."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Literal

import pytest

from hwp_bench.base.errors import BadMethod, UsageError
from hwp_bench.methods.settings import choice, number, settings_from


@dataclass(frozen=True)
class Inner:
    width: int = number(4, 1, 10)
    kind: str = choice("one", "two")
    shape: Literal["round", "flat"] = "round"

    def __post_init__(self) -> None:
        if self.width == 7:
            raise UsageError("is 7", field="width")


@dataclass(frozen=True)
class Outer:
    rate: float = 0.5
    on: bool = True
    limit: float | None = None
    inner: Inner = field(default_factory=Inner)


def test_tables_and_dotted_names_mean_the_same() -> None:
    expected = Outer(rate=1.0, on=False, limit=3.0, inner=Inner(2, "two"))
    tables = {"rate": 1, "on": False, "limit": 3, "inner": {"width": 2, "kind": "two"}}
    assert settings_from(Outer, tables, "here") == expected
    flat = {"rate": 1, "on": False, "limit": 3, "inner.width": 2, "inner.kind": "two"}
    assert settings_from(Outer, flat, "here") == expected


def test_what_comes_later_wins() -> None:
    values = {"inner": {"width": 2, "kind": "two"}, "inner.width": 5}
    assert settings_from(Outer, values, "here").inner == Inner(5, "two")


@pytest.mark.parametrize(
    ("values", "message"),
    [
        ({"inner": 3}, "inner: must be a table"),
        ({"inner.widht": 3}, r"inner\.widht: is not known\. Did you mean 'inner\.width'"),
        ({"inner": {"width": 11}}, r"inner\.width: is 11, expected an integer from 1 to 10"),
        ({"inner": {"width": 7}}, r"inner\.width: is 7"),
        ({"inner.kind": "three"}, "one, two"),
        ({"inner.shape": "oval"}, r"inner\.shape: is 'oval'.*round, flat"),
        ({"on": 1}, "on: .*true or false"),
        ({"limit": "none"}, "limit: is 'none', expected a finite number at least 0"),
        ({"rate": {"a": 1}}, "rate"),
    ],
)
def test_mistakes_are_named(values: dict[str, object], message: str) -> None:
    with pytest.raises(BadMethod, match=message):
        settings_from(Outer, values, "here")
