"""How `hwp_bench.base.records` has `msgspec` check a dataclass, and what it says when that fails.

`strict_twin` turns a dataclass into a `msgspec.Struct` that refuses whatever the dataclass does not
declare. `msgspec` decides whether a value is good; `explain` finds the place of a fault in a value
that it refused, because its own messages name neither the key of a table nor the value.
"""

from __future__ import annotations

import collections.abc
import dataclasses
import math
import reprlib
import sys
import types
import typing
from collections.abc import Iterable, Iterator, Mapping
from functools import cache
from typing import Annotated, Any, Literal, Union

import msgspec
from msgspec import UNSET, Meta

from hwp_bench.base.text import ODD_CHARACTERS, has_odd_characters, is_unicode, nearest, shown

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
    removed = [(name, Any, UNSET) for name in getattr(kind, "removed_fields", ())]
    return msgspec.defstruct(
        kind.__name__,
        [*fields, *removed],
        kw_only=True,
        forbid_unknown_fields=not rules.ignore_unknown,
        namespace={
            "__record__": kind,
            "__removed__": getattr(kind, "removed_fields", ()),
            "__free__": [item.name for item in dataclasses.fields(kind) if _free(hints[item.name])],
        },
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
        metas = tuple(_without_denormals(meta) for meta in metas)
        metas = (*metas, *_bounds(hint, metas, metadata.get("range", (rules.low, rules.high))))
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


def _without_denormals(meta: Any) -> Any:
    """The same bounds where denormals are flushed to zero.

    `msgspec` takes "above 0" for "at least the smallest float". That is a denormal, which is equal
    to 0 where they are flushed, so that 0 would pass.
    """
    changed: dict[str, Any] = {}
    if isinstance(meta.gt, float) and meta.gt == 0.0:
        changed |= {"gt": None, "ge": _LEAST}
    if isinstance(meta.lt, float) and meta.lt == 0.0:
        changed |= {"lt": None, "le": -_LEAST}
    if not changed:
        return meta
    names = ("gt", "ge", "lt", "le", "description")
    return Meta(**{name: getattr(meta, name) for name in names} | changed)


def _bounds(kind: type, metas: tuple[Any, ...], limits: tuple[float, float]) -> Iterator[Meta]:
    # The largest float keeps infinity out, and NaN is above no bound.
    own = _limits(metas)
    low, high = (-math.inf, math.inf) if own else limits
    if kind is float:
        low, high = max(low, -_LARGEST), min(high, _LARGEST)
    if math.isfinite(low) and not {"ge", "gt"} & own.keys():
        yield Meta(ge=kind(low))
    if math.isfinite(high) and not {"le", "lt"} & own.keys():
        yield Meta(le=kind(high))


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
    limits = {name: value for name, value in rules.items() if abs(value) < _LARGEST}
    if limits.get("ge") == _LEAST:
        limits = {"gt": 0.0} | {name: limits[name] for name in limits if name != "ge"}
    if limits.get("le") == -_LEAST:
        limits = {name: limits[name] for name in limits if name != "le"} | {"lt": 0.0}
    if {"ge", "le"} == limits.keys():
        return f"{words[kind]} from {limits['ge']:g} to {limits['le']:g}"
    bounds = " and ".join(f"{sides[name]} {value:g}" for name, value in limits.items())
    return f"{words.get(origin or kind, 'another value')} {bounds}".strip()


def _remedy(name: str, path: str, kind: type[msgspec.Struct]) -> str:
    known = [n for n in kind.__struct_fields__ if n not in kind.__removed__]  # type: ignore[attr-defined]
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
