"""Frozen dataclasses from untrusted JSON or TOML: the one reader of every format.

A format is a frozen dataclass; `parse_record` makes one out of a table that a file held::

    @dataclass(frozen=True)
    class Lamp:
        name: Line                                     # one line of text, required
        power: float = number(1.0, 0.0, 100.0)         # bounded; may be absent
        kind: Literal["disc", "point"] = "disc"        # one of several words
        place: tuple[float, float, float] = (0.0, 0.0, 0.0)
        gains: list[Annotated[float, Meta(gt=0.0, lt=10.0)]] | None = None

    lamp = parse_record(Lamp, table, where="scene.toml", field="lamps[0]", error=BadInput)

Fields are str, int, float, bool, Literal, `list[X]`, `dict[str, X]`, `tuple[...]`, other
dataclasses, any of these `| None`, or `Any` (whatever `check_json_values` lets through).
`msgspec` does the checking, on a strict twin of the dataclass: a bool is not an int, an int is a
float, NaN and infinity are refused, and so is text with control characters. Bounds are
`msgspec.Meta` in an `Annotated` type, or the metadata of `number` and `choice`. A pattern in a
`Meta` needs a `description`, which messages show, and must exclude control characters itself.

A missing field takes its default, so that a format may get additional fields. A field that was
taken out of a format stays readable when the class lists it::

    removed_fields: ClassVar[tuple[str, ...]] = ("loss",)

What no type can say belongs in `__post_init__`, which raises `UsageError(problem, field=name)`;
the reader adds the file and the path.
"""

from __future__ import annotations

import dataclasses
import math
import os
from collections.abc import Iterator, Mapping
from functools import partial
from typing import Annotated, Any, TypeVar, cast

import msgspec
from msgspec import UNSET, Meta

from hwp_bench.base.errors import BadResult, HwpError
from hwp_bench.base.files import MAX_JSON_INTEGER
from hwp_bench.base.record_types import Rules, brief, explain, join, strict_twin
from hwp_bench.base.text import ODD_CHARACTERS, has_odd_characters, shown

Record = TypeVar("Record")

#: Deepest table in a table that `flattened` looks into.
MAX_DEPTH = 8

#: Most characters of a text that is not one line.
MAX_TEXT = 10_000
#: Longest time span, s.
MAX_SECONDS = 1e9
#: Largest count.
MAX_COUNT = 2**53
#: Largest seed.
MAX_SEED = 2**63 - 1

#: Longest piece of a name or value that a message repeats.
_SHOWN = 100

#: A text of at most 1,000 characters without a line break.
Line = Annotated[
    str,
    Meta(
        pattern=rf"\A[^\n{ODD_CHARACTERS}]*\Z",
        max_length=1000,
        description="one line of at most 1,000 characters",
    ),
]
#: A text that is not empty, of at most 10,000 characters.
Text = Annotated[str, Meta(min_length=1, max_length=MAX_TEXT)]
#: A text that may be empty or have several lines, such as the reason of a failure.
Message = Annotated[str, Meta(max_length=MAX_TEXT)]
#: A time span, s: at most 31 years.
Seconds = Annotated[float, Meta(ge=0.0, le=MAX_SECONDS)]
#: A number of steps, frames or bytes: at most the largest that floats count exactly.
Count = Annotated[int, Meta(ge=0, le=MAX_COUNT)]
#: A SHA-256 in hexadecimal digits.
Digest = Annotated[str, Meta(pattern=r"\A[0-9a-f]{64}\Z", description="64 hexadecimal digits")]
#: A seed of random numbers.
Seed = Annotated[int, Meta(ge=0, le=MAX_SEED)]


def number(default: Any, low: float = 0.0, high: float = math.inf) -> Any:
    """A dataclass field for a number within [low, high]."""
    return dataclasses.field(default=default, metadata={"range": (low, high)})


def choice(default: str, *others: str) -> Any:
    """A dataclass field for one of several words."""
    return dataclasses.field(default=default, metadata={"choices": (default, *others)})


def parse_record(
    kind: type[Record],
    value: Any,
    *,
    where: str | os.PathLike[str],
    field: str = "",
    error: type[HwpError] = BadResult,
    numbers: tuple[float, float] = (-math.inf, math.inf),
    complete: bool = False,
    ignore_unknown: bool = False,
) -> Record:
    """Make a dataclass out of a table, checking every field by its annotation.

    Args:
        kind: the dataclass; see the module.
        value: what the file holds.
        where: the file, for messages.
        field: path of `value` in the file, such as `captures[0]`; empty for the whole file.
        error: raised when something is wrong.
        numbers: range of numbers that have no bounds of their own.
        complete: refuse a missing field even where the dataclass has a default.
        ignore_unknown: skip unknown fields instead of refusing them.

    Raises:
        error: the value is not a table, or a field is missing, unknown (the message says which
            name is close), of the wrong type, out of range, not finite, or holds a control
            character; or the dataclass refuses the values together. File and field are named.
    """
    rules = Rules(*numbers, complete, ignore_unknown)
    twin = strict_twin(cast("type", kind), rules)

    def refuse(problem: str, path: str, remedy: str | None = None) -> HwpError:
        return error(problem, where=where, field=shown(path) or None, remedy=remedy)

    def build(item: Any, path: str) -> Any:
        if isinstance(item, dict):
            return {key: build(part, join(path, key)) for key, part in item.items()}
        if isinstance(item, list | tuple):
            return type(item)(build(part, f"{path}[{i}]") for i, part in enumerate(item))
        if not isinstance(item, msgspec.Struct):
            return item
        names = set(item.__struct_fields__) - set(item.__removed__)  # type: ignore[attr-defined]
        given = {name: getattr(item, name) for name in names}
        for name in item.__free__:  # type: ignore[attr-defined]
            if given[name] is not UNSET:
                place = join(path, name)
                check_json_values(given[name], where=where, field=place, error=error, null=True)
        made = {n: build(v, join(path, n)) for n, v in given.items() if v is not UNSET}
        try:
            return item.__record__(**made)  # type: ignore[attr-defined]
        except HwpError as fault:
            raise refuse(fault.problem, join(path, fault.field or ""), fault.remedy) from fault

    start = field.rstrip(".")
    try:
        converted = msgspec.convert(value, twin)
    # The second: half of a surrogate pair, where `msgspec` looks a text up.
    except (msgspec.ValidationError, UnicodeEncodeError) as fault:
        raise refuse(*explain(twin, value, start)) from fault
    return build(converted, start)


def without_schema(
    value: Any,
    schema: str,
    *,
    where: str | os.PathLike[str],
    error: type[HwpError] = BadResult,
    remedy: str | None = None,
) -> dict[str, Any]:
    """Check the version that a file states in its field `schema`; return the other fields.

    Raises:
        error: the value is not a table, or is of another version.
    """
    if not isinstance(value, dict):
        raise error("must be a JSON object", where=where)
    found = value.get("schema")
    if found != schema:
        stated = f"is {brief(found)}" if "schema" in value else "is missing"
        problem = f"{stated} where {schema!r} is read"
        raise error(problem, where=where, field="schema", remedy=remedy)
    return {key: item for key, item in value.items() if key != "schema"}


def unfold(values: Mapping[str, Any]) -> dict[str, Any]:
    """Turn dotted names into tables: `{"a.b": 1}` means `{"a": {"b": 1}}`.

    Tables that are named twice are merged; later entries win.
    """
    tree: dict[str, Any] = {}
    for name, value in values.items():
        head, dot, rest = str(name).partition(".")
        if dot:
            value = {rest: value}
        tree = merged(tree, {head: unfold(value) if isinstance(value, Mapping) else value})
    return tree


def flattened(values: Mapping[str, Any], prefix: str = "") -> Iterator[tuple[str, Any]]:
    """Yield every value with its name, `table.field`; the inverse of `unfold`.

    An empty table is a value, and so is one that lies deeper than `MAX_DEPTH` tables.
    """
    for name, value in values.items():
        if isinstance(value, Mapping) and value and prefix.count(".") < MAX_DEPTH:
            yield from flattened(value, f"{prefix}{name}.")
        else:
            yield f"{prefix}{name}", value


def merged(tables: Mapping[str, Any], changes: Mapping[str, Any]) -> dict[str, Any]:
    """Return tables within tables, some values changed; a table given in part keeps the rest."""
    whole = dict(tables)
    for name, value in changes.items():
        before = whole.get(name)
        if isinstance(before, Mapping) and isinstance(value, Mapping):
            value = merged(before, value)
        whole[name] = value
    return whole


def check_json_values(
    value: Any,
    *,
    where: str | os.PathLike[str],
    field: str,
    error: type[HwpError] = BadResult,
    depth: int = 16,
    null: bool = False,
) -> None:
    """Refuse what JSON cannot hold: for values of type `Any` that are kept or digested.

    Args:
        value: numbers, texts, truth values, or lists or tables of such.
        where: the file, for messages.
        field: path of `value` in the file.
        error: raised when something is wrong.
        depth: deepest nesting that is accepted.
        null: accept None, which JSON has and TOML has not.

    Raises:
        error: there is a date or other object, a number that is not finite or is absurdly large,
            a text that is too long or holds a control character, or too deep a nesting; the field
            is named.
    """
    problem = None
    check = partial(check_json_values, where=where, error=error, depth=depth - 1, null=null)
    if depth == 0:
        problem = "is nested too deeply"
    elif isinstance(value, dict):
        for name, item in value.items():
            path = join(field, str(name))
            check(str(name), field=path, depth=1)
            check(item, field=path)
    elif isinstance(value, list | tuple):
        for item in value:
            check(item, field=field)
    elif isinstance(value, float) and not math.isfinite(value):
        problem = f"is {value}, not a finite number"
    elif isinstance(value, int) and abs(value) > MAX_JSON_INTEGER:
        problem = "is too large a number"
    elif isinstance(value, str) and len(value) > MAX_TEXT:
        problem = f"is a text of more than {MAX_TEXT:,} characters"
    elif isinstance(value, str) and has_odd_characters(value):
        problem = "holds a control character"
    elif not isinstance(value, str | int | float) and not (null and value is None):
        problem = f"is a {type(value).__name__}, not a number, text, list or table"
    if problem:
        raise error(problem, where=where, field=shown(field)[:_SHOWN])
