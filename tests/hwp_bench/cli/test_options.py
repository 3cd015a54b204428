"""`--set`. Oracle: TOML's own values."""

from __future__ import annotations

import pytest

from hwp_bench.base.errors import UsageError
from hwp_bench.cli.options import overrides


@pytest.mark.parametrize(
    ("text", "name", "value"),
    [
        ("steps=300", "steps", 300),
        ("rates.dpd=1e-3", "rates.dpd", 1e-3),
        ("dpd=false", "dpd", False),
        ('mode="paper"', "mode", "paper"),
        ("mode=paper", "mode", "paper"),
        ("prior=", "prior", ""),
        ("prior=/data/my=prior", "prior", "/data/my=prior"),
        ("sizes=[1, 2]", "sizes", [1, 2]),
    ],
)
def test_a_value_is_toml_or_a_word(text: str, name: str, value: object) -> None:
    assert overrides([text]) == {name: value}


def test_the_last_of_a_name_holds() -> None:
    assert overrides(["steps=1", "batch=2", "steps=3"]) == {"steps": 3, "batch": 2}


@pytest.mark.parametrize("text", ["steps", "=1", "a b=1", "a.=1", ".a=1", "a..b=1", "../a=1"])
def test_what_is_no_name_is_refused(text: str) -> None:
    with pytest.raises(UsageError, match="is not NAME=VALUE"):
        overrides([text])


@pytest.mark.parametrize("value", ["{b=1", "[1, 2", '"word', "'word", "[bold]", ' {b="c}'])
def test_what_begins_as_toml_is_toml(value: str) -> None:
    with pytest.raises(UsageError, match="looks like TOML and is not") as error:
        overrides([f"a={value}"])
    assert error.value.where == "--set"


@pytest.mark.parametrize("texts", [["a=1", "a.b=2"], ["a.b=2", "a=1"], ["a.b.c=1", "a.b=word"]])
def test_a_name_is_a_value_or_a_table(texts: list[str]) -> None:
    with pytest.raises(UsageError, match="is a value, and a table in"):
        overrides(texts)
    assert overrides(["a={c=1}", "a.b=2"]) == {"a": {"c": 1}, "a.b": 2}
