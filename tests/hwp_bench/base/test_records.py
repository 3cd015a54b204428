"""The record reader. Oracle: the dataclass built by hand, and the standard types of JSON."""

from __future__ import annotations

import json
import math
import sys
from dataclasses import asdict, dataclass, field, make_dataclass
from typing import Annotated, Any, Literal

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from msgspec import Meta

from hwp_bench.base.errors import BadInput, BadMethod, BadResult, UsageError
from hwp_bench.base.numerics import flushed, flushes
from hwp_bench.base.records import (
    MAX_CHARACTERS,
    MAX_DEPTH,
    MAX_TOML_DEPTH,
    Line,
    Text,
    check_json_values,
    choice,
    number,
    parse_record,
    parse_toml,
    unfold,
    without_schema,
)
from hwp_bench.cli.options import overrides
from hwp_bench.sim.scene_files import parse_scene, scene_path


@dataclass(frozen=True)
class Part:
    width: int = number(4, 1, 10)
    kind: str = choice("one", "two")
    shape: Literal["round", "flat"] = "round"

    def __post_init__(self) -> None:
        if self.width == 7:
            raise UsageError("is 7", field="width", remedy="Use 8.")


@dataclass(frozen=True)
class Whole:
    count: int
    rate: float = 0.5
    on: bool = True
    limit: float | None = None
    part: Part = field(default_factory=Part)
    parts: list[Part] = field(default_factory=list)
    scores: dict[str, float] = field(default_factory=dict)
    place: tuple[float, float, float] = (0.0, 0.0, 0.0)
    steps: tuple[int, ...] = ()
    line: Line = ""
    text: Text = "text"
    free: dict[str, Any] = field(default_factory=dict)
    fps: Annotated[float, Meta(gt=0.0, lt=1000.0)] = 30.0


def read(**values: Any) -> Whole:
    return parse_record(Whole, {"count": 1, **values}, where="file.json")


def test_what_is_absent_has_its_default() -> None:
    assert read() == Whole(1)
    assert read(part={"width": 2}) == Whole(1, part=Part(2))


finite = st.floats(allow_nan=False, allow_infinity=False)
plain = st.text(st.characters(codec="ascii", categories=["L", "N", "P"]), max_size=8)


@settings(max_examples=100, deadline=None, suppress_health_check=[HealthCheck.too_slow])
@given(
    st.builds(
        Whole,
        count=st.integers(-(2**60), 2**60),
        rate=finite,
        on=st.booleans(),
        limit=st.none() | finite,
        parts=st.lists(st.builds(Part, width=st.integers(1, 6)), max_size=3),
        scores=st.dictionaries(plain, finite, max_size=3),
        place=st.tuples(finite, finite, finite),
        steps=st.lists(st.integers(0, 9), max_size=3).map(tuple),
        line=plain,
        text=st.just("a\n\tb"),
        free=st.dictionaries(plain, st.none() | finite | st.lists(plain), max_size=3),
    )
)
def test_a_record_survives_json(record: Whole) -> None:
    assert parse_record(Whole, json.loads(json.dumps(asdict(record))), where="f") == record


@pytest.mark.parametrize(
    ("values", "message"),
    [
        ({"count": True}, "count: is True, expected an integer"),
        ({"count": 1.0}, "count: is 1.0, expected an integer"),
        ({"count": "1"}, "count: is '1', expected an integer"),
        ({"count": None}, "count: is None, expected an integer"),
        ({"rate": True}, "rate: is True, expected a finite number"),
        ({"rate": math.nan}, "rate: is nan, expected a finite number"),
        ({"rate": math.inf}, "rate: is inf, expected a finite number"),
        ({"rate": 10**400}, "rate: is an absurdly large number"),
        ({"limit": "none"}, "limit: is 'none', expected a finite number"),
        ({"on": 1}, "on: is 1, expected true or false"),
        ({"part": 3}, "part: must be a table"),
        ({"part": {"widht": 3}}, "part.widht: is not known. Did you mean 'part.width'?"),
        ({"colour": 3}, "colour: is not known. Known: count, rate, on"),
        ({"part": {"width": 11}}, "part.width: is 11, expected an integer from 1 to 10"),
        ({"part": {"width": 7}}, "file.json: part.width: is 7. Use 8."),
        ({"parts": [{}, {"kind": "four"}]}, "parts[1].kind: is 'four', expected one of one, two"),
        ({"part": {"shape": "oval"}}, "part.shape: is 'oval', expected one of round, flat"),
        ({"scores": {"a": 1, "b": math.inf}}, "scores.b: is inf"),
        ({"scores": {"p\x00": 1.0}}, "scores.p?: holds a control character"),
        ({"scores": [1.0]}, "scores: is [1.0], expected a table"),
        ({"parts": {}}, "parts: is {}, expected a list"),
        ({"place": [1, 2]}, "place: is [1, 2], expected a list of 3"),
        ({"place": [1, 2, "x"]}, "place[2]: is 'x', expected a finite number"),
        ({"steps": [1, 2.0]}, "steps[1]: is 2.0, expected an integer"),
        ({"line": "a\nb"}, "line: is 'a\\nb', expected one line of at most 1,000 characters"),
        ({"line": "\x1b[31m"}, "line: holds a control character"),
        ({"line": "x" * 1001}, "expected one line of at most 1,000 characters"),
        ({"text": ""}, "text: is '', expected a text of 1 to 10,000 characters"),
        ({"text": "a\u202eb"}, "text: holds a control character"),
        ({"fps": 0}, "fps: is 0, expected a finite number above 0 and below 1000"),
        ({"fps": math.nan}, "fps: is nan"),
        ({"\x1b[2J": 1}, "?[2J: is not known"),
    ],
)
def test_faults_are_named(values: dict[str, Any], message: str) -> None:
    with pytest.raises(BadResult) as caught:
        read(**values)
    assert message in str(caught.value)
    assert "\x1b" not in str(caught.value)
    assert len(str(caught.value)) < 300


@pytest.mark.parametrize("value", [0, 0.0, -0.0, 5e-324, 1e-310])
def test_zero_is_not_above_zero_where_denormals_are_flushed(value: float) -> None:
    # As in every process of ours. Least that passes: the smallest normal number.
    below = make_dataclass("Below", [("field", Annotated[float, Meta(lt=0.0)])], frozen=True)
    with flushed():
        assert flushes()
        with pytest.raises(BadResult, match=r"fps: is .*, expected a finite number above 0 and"):
            read(fps=value)
        with pytest.raises(BadResult, match=r"field: is .*, expected a finite number below 0"):
            parse_record(below, {"field": -value}, where="file")
        assert read(fps=sys.float_info.min).fps == sys.float_info.min


def test_the_caller_chooses_path_error_and_strictness() -> None:
    with pytest.raises(BadMethod, match=r"^m\.toml: a\[0\]\.count: is missing$"):
        parse_record(Whole, {}, where="m.toml", field="a[0]", error=BadMethod)
    with pytest.raises(BadInput, match=r"^f: must be a table"):
        parse_record(Whole, [], where="f", error=BadInput)
    with pytest.raises(BadResult, match="rate: is -1, expected a finite number at least 0"):
        parse_record(Whole, {"count": 1, "rate": -1}, where="f", numbers=(0.0, math.inf))
    with pytest.raises(BadResult, match="is missing"):
        parse_record(Whole, {"count": 1}, where="f", complete=True)
    loose = {"count": 1, "more": 2, "part": {"more": 1}}
    assert parse_record(Whole, loose, where="f", ignore_unknown=True) == Whole(1)


def test_dotted_names_are_tables() -> None:
    assert unfold({"a.b.c": 1, "a.b": {"d": 2}, "e": 3}) == {"a": {"b": {"c": 1, "d": 2}}, "e": 3}
    assert unfold({"a": {"b.c": 1}, "a.b.c": 2}) == {"a": {"b": {"c": 2}}}
    assert unfold({"a.b": 1, "a": {"c": 2}}) == {"a": {"b": 1, "c": 2}}


def test_a_name_of_thousands_of_parts_makes_a_few_tables() -> None:
    # A table for each would end Python's recursion. The last name keeps the other parts.
    tree, levels = unfold({".".join("a" * 5000): 1}), 0
    while isinstance(tree, dict):
        ((name, tree),) = tree.items()
        levels += 1
    assert (levels, len(name)) == (MAX_DEPTH + 1, 2 * (5000 - MAX_DEPTH) - 1)


def test_versions_are_checked() -> None:
    assert without_schema({"schema": "a/1", "b": 2}, "a/1", where="f") == {"b": 2}
    with pytest.raises(BadResult, match="f: schema: is 'a/2' where 'a/1' is read"):
        without_schema({"schema": "a/2"}, "a/1", where="f")
    with pytest.raises(BadResult, match="f: schema: is missing where 'a/1' is read"):
        without_schema({}, "a/1", where="f")
    with pytest.raises(BadInput, match="f: must be a JSON object"):
        without_schema([], "a/1", where="f", error=BadInput)


@pytest.mark.parametrize(
    ("value", "message"),
    [
        ({"a": [1, math.nan]}, r"s\.a: is nan, not a finite number"),
        ({"a": 2**64}, r"s\.a: is too large a number"),
        ({"a": {1, 2}}, r"s\.a: is a set, not a number, text, list or table"),
        ({"a": None}, r"s\.a: is a NoneType"),
        ([[[[1]]]], "nested too deeply"),
        ({"a": "\ud800"}, r"s\.a: holds a control character"),
        ({"a\x1b": 1}, r"s\.a\?: holds a control character"),
        ({"a": "x" * 10_001}, r"s\.a: is a text of more than 10,000 characters"),
    ],
)
def test_values_that_json_cannot_hold_are_refused(value: Any, message: str) -> None:
    check_json_values({"a": [1, "b", True, 0.5]}, where="f", field="s")
    with pytest.raises(BadResult, match=message):
        check_json_values(value, where="f", field="s", depth=4)


@pytest.mark.parametrize(
    "value", ["\ud800", "a\x1b", "x" * 10_001, math.inf, [[[[]]]] * 2 + [{"k\udcff": 1}]]
)
def test_fields_of_any_type_are_looked_into(value: Any) -> None:
    """They had been passed on unseen, a terminal's escapes among them."""
    assert read(free={"null": {"is": None}}).free == {"null": {"is": None}}
    with pytest.raises(BadResult, match=r"file\.json: free"):
        read(free={"name": value})


def test_a_name_that_is_no_unicode_is_refused() -> None:
    with pytest.raises(BadResult, match="holds a name that is not Unicode"):
        read(**{"\ud800": 1})
    with pytest.raises(BadResult, match=r"line: is '\?'|line: holds a control character"):
        read(line="\udcff")


@pytest.mark.parametrize(
    ("kind", "value", "expected"),
    [
        (Annotated[list[int], Meta(min_length=2)], [1], "a list of at least 2 entries"),
        (Annotated[list[int], Meta(max_length=2)], [1, 2, 3], "a list of 0 to 2 entries"),
        (Annotated[list[int], Meta(min_length=1, max_length=2)], [], "a list of 1 to 2 entries"),
        (Annotated[dict[str, int], Meta(min_length=1)], {}, "a table of at least 1 entries"),
        (Annotated[dict[str, int], Meta(max_length=1)], {"a": 1, "b": 2}, "a table of 0 to 1"),
        (Annotated[str, Meta(min_length=2)], "a", "a text of at least 2 characters"),
        (Annotated[str, Meta(max_length=2)], "abc", "a text of 0 to 2 characters"),
        (Annotated[int, Meta(ge=1)], 0, "an integer at least 1"),
        (Annotated[int, Meta(gt=1)], 1, "an integer above 1"),
        (Annotated[int, Meta(ge=1, le=3)], 4, "an integer from 1 to 3"),
        (Annotated[float, Meta(lt=1.0)], 1.0, "a finite number .*below 1"),
        (Annotated[float, Meta(gt=0.0, lt=1.0)], 0.0, "a finite number above 0 and below 1"),
    ],
    ids=str,
)
def test_every_kind_of_bound_has_its_words(kind: Any, value: Any, expected: str) -> None:
    bounded = make_dataclass("Bounded", [("field", kind)], frozen=True)
    with pytest.raises(BadResult, match=f"file: field: is .*, expected {expected}"):
        parse_record(bounded, {"field": value}, where="file")


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
