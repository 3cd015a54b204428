"""TOML from outside. Oracle: what every reader of it must do, a sentence or the value."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from hwp_bench.base.errors import BadInput, UsageError
from hwp_bench.base.records import MAX_CHARACTERS, MAX_TOML_DEPTH, parse_toml
from hwp_bench.cli.options import overrides
from hwp_bench.sim.scene.reader import parse_scene, scene_path

LONG = "9" * 5000
DEEP = "[" * 5000 + "]" * 5000


@pytest.mark.parametrize(
    ("value", "problem"),
    [
        (LONG, "absurdly large"),
        (f"-{LONG}", "absurdly large"),
        ("0x" + "f" * 5000, "absurdly large"),
        (str(2**300), "absurdly large"),
        (DEEP, "nested too deeply"),
        ("[" * (MAX_TOML_DEPTH + 1) + "]" * (MAX_TOML_DEPTH + 1), "nested too deeply"),
        ("{a = " * 400 + "1" + "}" * 400, "nested too deeply"),
        ("'\ud800'", "cannot be Unicode"),
        ("'" + "x" * MAX_CHARACTERS + "'", "more than"),
        ("1 2", "not valid TOML"),
        ('"\\ud800"', "not valid TOML"),
        ("1\n" + ".".join("a" * 450_000) + " = 1", "nested too deeply"),
        ("1\n[" + " . ".join(['"a"'] * 100_000) + "]", "nested too deeply"),
    ],
)
def test_what_is_out_of_bounds_is_one_message(value: str, problem: str) -> None:
    with pytest.raises(BadInput, match=problem) as caught:
        parse_toml(f"seed = {value}", where="scene.toml")
    assert len(str(caught.value)) < 500
    text = scene_path("capture0").read_text("utf-8").replace("seed = 1000", f"seed = {value}")
    with pytest.raises(BadInput):
        parse_scene(text, where="scene.toml")


@pytest.mark.parametrize("value", [LONG, DEEP, f"[{LONG}]", "{a = " * 400 + "1" + "}" * 400])
def test_a_setting_out_of_bounds_is_one_message(value: str) -> None:
    with pytest.raises(UsageError, match="--set") as caught:
        overrides([f"level={value}"])
    assert len(str(caught.value)) < 500


@pytest.mark.parametrize("value", ["\udcff", "a\x1b[2J", "\u202e"])
def test_a_setting_that_steers_a_terminal_is_refused(value: str) -> None:
    with pytest.raises(UsageError, match=r"control character|not UTF-8|cannot be Unicode"):
        overrides([f"level={value}"])


def test_a_name_of_many_tables_is_refused() -> None:
    with pytest.raises(UsageError, match="too deep"):
        overrides([".".join("a" * 3000) + "=1"])


@given(st.text(max_size=200))
def test_any_text_is_a_value_or_one_message(text: str) -> None:
    try:
        found = overrides([f"level={text}"])
    except UsageError:
        return
    assert set(found) == {"level"}


@pytest.mark.parametrize("largest", ["1e200", "1e308", "11.0"])
def test_strengths_of_effects_are_bounded(largest: str) -> None:
    text = scene_path("capture0").read_text("utf-8")
    changed = text.replace("0.1309, 0.1985, 0.2]", f"0.1309, 0.1985, {largest}]")
    assert changed != text
    with pytest.raises(BadInput, match=r"effects\[1\]\.strengths.*0 to 10"):
        parse_scene(changed, where="scene.toml")
