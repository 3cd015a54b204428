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
dataclasses, any of these `| None`, or `Any` (whatever `check_json_values` lets through). A bool is
not an int, an int is a float, NaN and infinity are refused, and so is text with control
characters. Bounds are `msgspec.Meta` in an `Annotated` type, or the metadata of `number` and
`choice`. A pattern in a `Meta` needs a `description`, which messages show.

`msgspec` itself does not read them: its messages name neither the key of a table nor the value.

A missing field takes its default, so that a format may get additional fields.
What no type can say belongs in `__post_init__`, which raises `UsageError(problem, field=name)`;
the reader adds the file and the path.
"""

from __future__ import annotations

import collections.abc
import contextlib
import dataclasses
import math
import operator
import os
import re
import reprlib
import sys
import tomllib
import types
import typing
from collections.abc import Callable, Iterator, Mapping
from functools import cache, partial
from typing import Annotated, Any, Literal, NamedTuple, TypeVar, Union, cast

from msgspec import Meta

from hwp_bench.base.errors import (
    ODD_CHARACTERS,
    BadInput,
    BadResult,
    HwpError,
    has_odd_characters,
    is_unicode,
    nearest,
    shown,
)
from hwp_bench.base.files import MAX_JSON_INTEGER, inner_values

# Longest piece of a name or value that a message repeats.
_SHOWN = 100
_REPR = reprlib.Repr()
_REPR.maxstring = _REPR.maxother = _REPR.maxlong = _SHOWN - 20
_LARGEST = sys.float_info.max
# Where denormals are flushed, as in our processes, a smaller difference is none.
_LEAST = sys.float_info.min
# The bounds of a number, and their words.
_BOUNDS: dict[str, tuple[Callable[[Any, Any], bool], str]] = {
    "ge": (operator.ge, "at least"),
    "gt": (lambda value, bound: value > bound and value >= bound + _LEAST, "above"),
    "le": (operator.le, "at most"),
    "lt": (lambda value, bound: value < bound and value <= bound - _LEAST, "below"),
}
_RULES = (*_BOUNDS, "min_length", "max_length", "pattern", "description")
_WORDS = {bool: "true or false", int: "an integer", float: "a finite number", str: "a text"}
_WORDS |= {list: "a list", tuple: "a list", dict: "a table"}
_PLAIN = {collections.abc.Sequence: list, collections.abc.Mapping: dict}


class _Form(NamedTuple):
    """A type without `Annotated` and `| None`, its parts, and what its `Meta`s state."""

    kind: Any
    #: Forms; words of a `Literal`, and `...` in a tuple of any length, stay as they are.
    parts: tuple[Any, ...]
    rules: dict[str, Any]
    optional: bool


def _form(hint: Any) -> _Form:
    rules: dict[str, Any] = {}
    optional = False
    while True:
        origin, parts = typing.get_origin(hint), typing.get_args(hint)
        if origin is Annotated:
            hint = parts[0]
            stated = {name: getattr(meta, name) for meta in parts[1:] for name in _RULES}
            rules |= {name: rule for name, rule in stated.items() if rule is not None}
        elif origin in (Union, types.UnionType):
            hint, *others = (part for part in parts if part is not types.NoneType)
            optional |= len(others) < len(parts) - 1
            if others:
                return _Form(Union, (_form(hint), *map(_form, others)), rules, optional)
        else:
            if origin is not Literal:
                parts = tuple(part if part is ... else _form(part) for part in parts)
            return _Form(_PLAIN.get(origin, origin) or hint, parts, rules, optional)


class _Field(NamedTuple):
    """A field of a record: its name and type, the range of its numbers, and its default."""

    name: str
    form: _Form
    limits: tuple[float, float] | None
    required: bool


@cache
def _fields(kind: type) -> tuple[_Field, ...]:
    hints, missing = typing.get_type_hints(kind, include_extras=True), dataclasses.MISSING
    found = []
    for item in dataclasses.fields(kind):
        choices = item.metadata.get("choices")
        form = _form(Literal[tuple(choices)] if choices else hints[item.name])
        required = item.default is missing and item.default_factory is missing
        found.append(_Field(item.name, form, item.metadata.get("range"), required))
    return tuple(found)


@dataclasses.dataclass(frozen=True)
class _Reader:
    """One call of `parse_record`: checks a value by its type, and builds what it stands for."""

    where: str | os.PathLike[str]
    error: type[HwpError]
    numbers: tuple[float, float]
    complete: bool
    ignore_unknown: bool

    def refuse(self, problem: str, path: str, remedy: str | None = None) -> HwpError:
        return self.error(problem, where=self.where, field=shown(path) or None, remedy=remedy)

    def record(self, kind: Any, value: Any, path: str) -> Any:
        if not isinstance(value, Mapping):
            raise self.refuse("must be a table (a JSON object)", path)
        if not all(is_unicode(str(name)) for name in value):
            raise self.refuse("holds a name that is not Unicode", path)
        fields = _fields(kind)
        known = [item.name for item in fields]
        needed = {item.name for item in fields if item.required or self.complete}
        missing = needed - value.keys()
        unknown = set() if self.ignore_unknown else set(map(str, value.keys() - set(known)))
        for name in sorted(missing | unknown):
            if name in missing:
                raise self.refuse("is missing", join(path, name))
            near = nearest(name, known)
            remedy = f"Did you mean {join(path, near[0])!r}?" if near else ""
            remedy = remedy or f"Known: {', '.join(known)}."
            raise self.refuse("is not known", join(path, name[:_SHOWN]), remedy)
        made = {
            name: self.value(form, value[name], join(path, name), limits)
            for name, form, limits, _ in fields
            if name in value
        }
        try:
            return kind(**made)
        except HwpError as fault:
            raise self.refuse(fault.problem, join(path, fault.field or ""), fault.remedy) from fault

    def value(
        self, form: _Form, value: Any, path: str, limits: tuple[float, float] | None = None
    ) -> Any:
        kind, parts, rules, optional = form
        if value is None and optional:
            return None
        made, sound = value, type(value) is kind
        if kind is float or kind is int:
            # Every float is finite; the bounds of a number are its own, or else the limits.
            low, high = (-math.inf, math.inf) if rules else limits or self.numbers
            sound |= kind is float and type(value) is int
            sound = sound and low <= value <= high and (kind is int or abs(value) <= _LARGEST)
            tests = [(_BOUNDS[name][0], bound) for name, bound in rules.items() if name in _BOUNDS]
            if sound and all(test(value, bound) for test, bound in tests):
                return kind(value)
            if not rules:
                ends = {"ge": low, "le": high}
                rules = {name: end for name, end in ends.items() if math.isfinite(end)}
            sound = False
        elif kind is Any:
            check_json_values(value, where=self.where, field=path, error=self.error, null=True)
            return value
        elif dataclasses.is_dataclass(kind):
            return self.record(kind, value, path)
        elif kind is Union:
            for part in parts:
                with contextlib.suppress(HwpError):
                    return self.value(part, value, path, limits)
        elif kind is Literal:
            sound = any(value == one and type(value) is type(one) for one in parts)
        elif kind is str and isinstance(value, str):
            sound = not has_odd_characters(value)
            sound &= re.search(rules.get("pattern", ""), value) is not None
        elif kind is dict and isinstance(value, Mapping):
            made, sound = {}, True
            for key, item in value.items():
                place = join(path, str(key)[:_SHOWN])
                made[self.value(parts[0], key, place)] = self.value(parts[1], item, place)
        elif kind in (list, tuple) and isinstance(value, list | tuple):
            one = kind is list or parts[-1] is ...
            kinds = [parts[0]] * len(value) if one else parts
            sound = len(kinds) == len(value)
            if sound:
                places = (f"{path}[{i}]" for i in range(len(value)))
                made = kind(map(self.value, kinds, value, places))
        if sound and {"min_length", "max_length"} & rules.keys():
            sound = rules.get("min_length", 0) <= len(made) <= rules.get("max_length", math.inf)
        if sound:
            return made
        if isinstance(value, str) and has_odd_characters(value):
            raise self.refuse("holds a control character", path)
        expected = _expected(form._replace(rules=rules))
        raise self.refuse(f"is {brief(value)}, expected {expected}", path)


def _expected(form: _Form) -> str:
    """Say in words what a value must be."""
    kind, parts, rules, _ = form
    if "description" in rules:
        return str(rules["description"])
    if kind is Literal:
        return f"one of {', '.join(map(str, parts))}"
    if kind is Union:
        return " or ".join(map(_expected, parts))
    if kind is tuple and parts[-1] is not ...:
        return f"a list of {len(parts)}"
    least, most = rules.get("min_length", 0), rules.get("max_length")
    if least or most is not None:
        size = f"at least {least:,}" if most is None else f"{least:,} to {most:,}"
        return f"{_WORDS[kind]} of {size} {'characters' if kind is str else 'entries'}"
    bounds = {name: rules[name] for name in _BOUNDS if name in rules}
    if bounds.keys() == {"ge", "le"}:
        return f"{_WORDS[kind]} from {bounds['ge']:g} to {bounds['le']:g}"
    said = " and ".join(f"{_BOUNDS[name][1]} {bound:g}" for name, bound in bounds.items())
    return f"{_WORDS[kind]} {said}".strip()


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
    """Make a dataclass out of a table, checking every field by its annotation."""
    reader = _Reader(where, error, numbers, complete, ignore_unknown)
    return cast("Record", reader.record(kind, value, field.rstrip(".")))


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
