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

A missing field takes its default, so that a format may get additional fields.
What no type can say belongs in `__post_init__`, which raises `UsageError(problem, field=name)`;
the reader adds the file and the path.

`msgspec` decides whether a value is good; `explain` finds the place of a fault in a value that it
refused, because its own messages name neither the key of a table nor the value.
"""

from __future__ import annotations

import collections.abc
import dataclasses
import math
import os
import re
import reprlib
import sys
import tomllib
import types
import typing
from collections.abc import Iterable, Iterator, Mapping
from functools import cache, partial
from typing import Annotated, Any, Literal, TypeVar, Union, cast

import msgspec
from msgspec import UNSET, Meta

from hwp_bench.base.errors import (
    ODD_CHARACTERS,
    BadInput,
    BadResult,
    HwpError,
    UsageError,
    has_odd_characters,
    is_unicode,
    nearest,
    shown,
    whole_number,
)
from hwp_bench.base.files import MAX_JSON_INTEGER, inner_values

# Longest piece of a name or value that a message repeats.
_SHOWN = 100
_REPR = reprlib.Repr()
_REPR.maxstring = _REPR.maxother = _REPR.maxlong = _SHOWN - 20
_LARGEST = sys.float_info.max
# The least float above 0 that is also above it where denormals are flushed, as in our processes.
_LEAST = sys.float_info.min
_PLAIN_TEXT = Meta(pattern=rf"\A[^{ODD_CHARACTERS}]*\Z")


@dataclasses.dataclass(frozen=True)
class Rules:
    """How strictly a record is read; see `hwp_bench.base.records.parse_record`."""

    low: float
    high: float
    complete: bool
    ignore_unknown: bool


@cache
def strict_twin(kind: type, rules: Rules) -> type[msgspec.Struct]:
    """The strict `msgspec.Struct` with the fields of a dataclass, which it has as `__record__`."""
    hints = typing.get_type_hints(kind, include_extras=True)
    fields: list[Any] = []
    for item in dataclasses.fields(kind):
        strict = _strict(hints[item.name], item.metadata, rules)
        optional = (item.default, item.default_factory) != (dataclasses.MISSING,) * 2
        if optional and not rules.complete:
            fields.append((item.name, Union[strict, msgspec.UnsetType], UNSET))  # noqa: UP007
        else:
            fields.append((item.name, strict))
    free = [item.name for item in dataclasses.fields(kind) if _free(hints[item.name])]
    return msgspec.defstruct(
        kind.__name__,
        fields,
        kw_only=True,
        forbid_unknown_fields=not rules.ignore_unknown,
        namespace={"__record__": kind, "__free__": free},
    )


def _free(hint: Any) -> bool:
    """Whether a type leaves values open, so that `msgspec` does not look at them."""
    return hint is Any or any(_free(part) for part in typing.get_args(hint))


def _strict(hint: Any, metadata: Mapping[str, Any], rules: Rules) -> Any:
    """The type of a field as `msgspec` is to check it."""
    metas: tuple[Any, ...] = ()
    if typing.get_origin(hint) is Annotated:
        hint, *given = typing.get_args(hint)
        metas = tuple(given)
    origin, parts = typing.get_origin(hint), typing.get_args(hint)
    if "choices" in metadata:
        strict: Any = Literal[tuple(metadata["choices"])]
    elif dataclasses.is_dataclass(hint):
        strict = strict_twin(typing.cast("type", hint), rules)
    elif hint in (int, float):
        metas = (_bounds(hint, metas, metadata.get("range", (rules.low, rules.high))),)
        strict = hint
    elif hint is str:
        if not any(isinstance(meta, Meta) and meta.pattern for meta in metas):
            metas = (*metas, _PLAIN_TEXT)
        strict = str
    elif origin in (Union, types.UnionType):
        strict = Union[tuple(_strict(part, metadata, rules) for part in parts)]  # noqa: UP007
    elif origin in (list, collections.abc.Sequence):
        strict = list[_strict(parts[0], {}, rules)]  # type: ignore[misc]
    elif origin in (dict, collections.abc.Mapping):
        strict = dict[_strict(parts[0], {}, rules), _strict(parts[1], {}, rules)]  # type: ignore[misc]
    elif origin is tuple:
        inner = (part if part is ... else _strict(part, {}, rules) for part in parts)
        strict = tuple[tuple(inner)]  # type: ignore[misc]
    else:
        strict = hint
    return Annotated[(strict, *metas)] if metas else strict


def _bounds(kind: type, metas: tuple[Any, ...], limits: tuple[float, float]) -> Meta:
    """The bounds of a number: its own, or else the limits; every float is finite."""
    own = _limits(metas)
    low, high = (-math.inf, math.inf) if own else limits
    if kind is float:
        # The largest float keeps infinity out, and NaN is above no bound.
        low, high = max(low, -_LARGEST), min(high, _LARGEST)
        # `msgspec` takes "above 0" for "at least the smallest float". That is a denormal, which is
        # equal to 0 where they are flushed, so that 0 would pass.
        if own.get("gt") == 0.0:
            own = {name: own[name] for name in own if name != "gt"} | {"ge": _LEAST}
        if own.get("lt") == 0.0:
            own = {name: own[name] for name in own if name != "lt"} | {"le": -_LEAST}
    if math.isfinite(low) and not {"ge", "gt"} & own.keys():
        own["ge"] = kind(low)
    if math.isfinite(high) and not {"le", "lt"} & own.keys():
        own["le"] = kind(high)
    return Meta(**own)


def _limits(metas: Iterable[Any]) -> dict[str, Any]:
    """The bounds and the description that the `Meta`s of a type state."""
    names = ("ge", "gt", "le", "lt", "min_length", "max_length", "description")
    found = [(name, getattr(meta, name, None)) for meta in metas for name in names]
    return {name: value for name, value in found if value is not None}


def explain(kind: Any, value: Any, path: str) -> tuple[str, str, str | None]:
    """Say what is wrong with a value that `msgspec` refuses: problem, path, remedy."""
    kind, metas = _unwrap(kind)
    if isinstance(kind, type) and issubclass(kind, msgspec.Struct):
        if not isinstance(value, Mapping):
            return "must be a table (a JSON object)", path, None
        if not all(is_unicode(str(name)) for name in value):
            return "holds a name that is not Unicode", path, None
        known = {item.name: item for item in msgspec.structs.fields(kind)}
        forbidden = kind.__struct_config__.forbid_unknown_fields
        missing = {name for name, item in known.items() if item.required} - value.keys()
        unknown = {str(name) for name in value.keys() - known.keys()} if forbidden else set()
        for name in sorted(missing | unknown):
            if name in missing:
                return "is missing", join(path, name), None
            return "is not known", join(path, name[:_SHOWN]), _remedy(name, path, kind)
    for part, item, place in _parts(kind, value, path):
        try:
            msgspec.convert(item, part)
        except (msgspec.ValidationError, UnicodeEncodeError):  # half of a surrogate pair
            return explain(part, item, place)
    if isinstance(value, str) and has_odd_characters(value):
        return "holds a control character", path, None
    return f"is {brief(value)}, expected {_expected(kind, metas)}", path, None


def _parts(kind: Any, value: Any, path: str) -> Iterator[tuple[Any, Any, str]]:
    """The parts of a value, each with its type and path; none where its form is wrong."""
    origin, types_ = typing.get_origin(kind), typing.get_args(kind)
    if isinstance(kind, type) and issubclass(kind, msgspec.Struct):
        for item in msgspec.structs.fields(kind):
            if item.name in value:
                yield item.type, value[item.name], join(path, item.name)
    elif origin is dict and isinstance(value, Mapping):
        for key, item in value.items():
            yield types_[0], key, join(path, str(key)[:_SHOWN])
            yield types_[1], item, join(path, str(key)[:_SHOWN])
    elif origin is list and isinstance(value, list | tuple):
        yield from ((types_[0], item, f"{path}[{i}]") for i, item in enumerate(value))
    elif origin is tuple and isinstance(value, list | tuple):
        kinds = [types_[0]] * len(value) if types_[-1] is ... else types_
        if len(kinds) == len(value):
            places = (f"{path}[{i}]" for i in range(len(value)))
            yield from zip(kinds, value, places, strict=True)


def _unwrap(kind: Any) -> tuple[Any, tuple[Any, ...]]:
    """Take `Annotated` and `| None` off a type."""
    metas: tuple[Any, ...] = ()
    while True:
        if typing.get_origin(kind) is Annotated:
            kind, *given = typing.get_args(kind)
            metas = (*given, *metas)
        elif typing.get_origin(kind) in (Union, types.UnionType):
            parts = [p for p in typing.get_args(kind) if p not in (type(None), msgspec.UnsetType)]
            if len(parts) != 1:
                return kind, metas
            kind = parts[0]
        else:
            return kind, metas


def _expected(kind: Any, metas: tuple[Any, ...]) -> str:
    """Say in words what a value must be."""
    rules = _limits(metas)
    origin, parts = typing.get_origin(kind), typing.get_args(kind)
    if "description" in rules:
        return rules["description"]
    if origin is Literal:
        return f"one of {', '.join(map(str, parts))}"
    if origin in (Union, types.UnionType):
        return " or ".join(
            _expected(*_unwrap(part)) for part in parts if part is not msgspec.UnsetType
        )
    if origin is tuple and parts[-1] is not ...:
        return f"a list of {len(parts)}"
    words = {bool: "true or false", int: "an integer", float: "a finite number", str: "a text"}
    words |= {list: "a list", tuple: "a list", dict: "a table", type(None): "null"}
    least, most = rules.get("min_length", 0), rules.get("max_length")
    if least or most is not None:
        size = f"at least {least:,}" if most is None else f"{least:,} to {most:,}"
        return f"{words[origin or kind]} of {size} {'characters' if kind is str else 'entries'}"
    sides = {"ge": "at least", "gt": "above", "le": "at most", "lt": "below"}
    # `_bounds` has no words for 0 and for every float.
    strict = {("ge", _LEAST): ("gt", 0.0), ("le", -_LEAST): ("lt", 0.0)}
    found = (strict.get(item, item) for item in rules.items() if abs(item[1]) < _LARGEST)
    limits: dict[str, float] = dict(found)
    if {"ge", "le"} == limits.keys():
        return f"{words[kind]} from {limits['ge']:g} to {limits['le']:g}"
    bounds = " and ".join(f"{sides[name]} {value:g}" for name, value in limits.items())
    return f"{words.get(origin or kind, 'another value')} {bounds}".strip()


def _remedy(name: str, path: str, kind: type[msgspec.Struct]) -> str:
    known = kind.__struct_fields__
    close = nearest(name, known)
    return f"Did you mean {join(path, close[0])!r}?" if close else f"Known: {', '.join(known)}."


def brief(value: Any) -> str:
    """Return a value as text, short enough for a message and safe for a terminal."""
    if isinstance(value, int) and value.bit_length() > 256:
        return "an absurdly large number"
    return shown(_REPR.repr(value))[:_SHOWN]


def join(path: str, name: str) -> str:
    """Join the path of a field and a name inside it."""
    return f"{path}.{name}" if path and name else path or name


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

#: A text of at most 1,000 characters without a line break.
Line = Annotated[
    str,
    Meta(
        pattern=rf"\A[^\n{ODD_CHARACTERS}]*\Z",
        max_length=1000,
        description="one line of at most 1,000 characters",
    ),
]
#: A moment, ISO 8601 in UTC.
Moment = Annotated[
    str,
    Meta(
        pattern=r"\A\d{4}-\d{2}-\d{2}T\d{2}:\d{2}:\d{2}\+00:00\Z",
        description="a moment such as 2026-01-01T00:00:00+00:00",
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


def whole_seed(value: Any, field: str) -> int:
    """Return a seed that every file and every generator can hold as Python's integer."""
    seed = whole_number(value, field)
    if not 0 <= seed <= MAX_SEED:
        raise UsageError(f"{brief(seed)} is not from 0 to {MAX_SEED}", field=field)
    return seed


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
    """Make a dataclass out of a table, checking every field by its annotation."""
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
        given = {name: getattr(item, name) for name in item.__struct_fields__}
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
    """Check the version that a file states in its field `schema`; return the other fields."""
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

    Tables that are named twice are merged; later entries win. One name makes at most `MAX_DEPTH`
    tables.
    """
    tree: dict[str, Any] = {}
    for name, value in values.items():
        *tables, last = str(name).split(".", MAX_DEPTH)
        branch: dict[str, Any] = {last: unfold(value) if isinstance(value, Mapping) else value}
        for table in reversed(tables):
            branch = {table: branch}
        tree = merged(tree, branch)
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
    """Refuse what JSON cannot hold: for values of type `Any` that are kept or digested."""
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
        raise error(problem, where=where, field=shown(field)[:100])


#: Longest TOML text that is read, characters; the longest scene that ships has 6,000.
MAX_CHARACTERS = 1_000_000
#: Deepest nesting of tables and lists that is read: no format here needs ten levels.
MAX_TOML_DEPTH = 32
#: Most bits of an integer. A field has closer bounds, and its reader names it; but Python turns
#: no integer of more than 4,300 digits into text, not even for a message.
MAX_BITS = 256

# A name of more parts than tables may be deep. The parser takes its square in steps: a text of a
# million characters would keep it for an hour.
_DEEP_NAME = re.compile(
    r"""(?<![\w"'-])(?:(?:[\w-]++|"[^"\n]*+"|'[^'\n]*+')[ \t]*+\.[ \t]*+){128}"""
)


def parse_toml(
    text: str,
    *,
    where: str | os.PathLike[str],
    field: str | None = None,
    error: type[HwpError] = BadInput,
) -> dict[str, Any]:
    """Make tables of TOML text."""

    def refuse(problem: str) -> HwpError:
        return error(problem, where=where, field=field)

    if len(text) > MAX_CHARACTERS:
        raise refuse(f"holds more than the {MAX_CHARACTERS:,} characters that are read")
    if not is_unicode(text):
        raise refuse("holds text that cannot be Unicode")
    if _DEEP_NAME.search(text):
        raise refuse("is nested too deeply")
    try:
        content = tomllib.loads(text)
        items = list(inner_values(content, MAX_TOML_DEPTH))
    except RecursionError as fault:
        raise refuse("is nested too deeply") from fault
    except tomllib.TOMLDecodeError as fault:
        raise refuse(f"is not valid TOML ({str(fault)[:300]})") from fault
    except ValueError as fault:  # Python converts no integer of more than 4,300 digits
        raise refuse("holds an absurdly large number") from fault
    if any(isinstance(item, int) and item.bit_length() > MAX_BITS for item in items):
        raise refuse("holds an absurdly large number")
    return content
