"""A class or function of Python as a method directory: its source, and what the source names.

Functions, classes, imports and constants that it uses are taken from its own file, or from the
cells of its notebook. Everything else has to be installed.
"""

from __future__ import annotations

import ast
import contextlib
import linecache
import logging
import symtable
import sys
import types
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from hwp_bench.base.errors import UsageError, one_line
from hwp_bench.base.files import atomic_write
from hwp_bench.methods.manifest import MANIFEST, SCHEMA
from hwp_bench.results.schema import UNDECLARED

# The class says nothing of its training, so that a result must not say "none".
_MANIFEST = """schema = "{schema}"
name = "{name}"
training = {{private = ["{undeclared}"]}}
[entry]
python = "method_source:{name}"
"""

_DEFINITIONS = (ast.FunctionDef, ast.AsyncFunctionDef, ast.ClassDef)


def write_method(factory: Any, root: Path) -> Path:
    """Write the method directory of what `entry.python` would name into a folder; returns it.

    Constants of numbers, texts, lists and tables have the values that they have now.

    Raises:
        UsageError: it is not defined at the top level of a file or notebook, or uses another value
            that a statement changes after the one that makes it.
    """
    name = getattr(factory, "__name__", "")
    module: Any = sys.modules.get(str(getattr(factory, "__module__", "")))
    statements: dict[str, None] = {}
    if getattr(module, name or " ", None) is factory:
        _collect(name, module, _sources(module), statements, set())
    if not statements:
        raise UsageError(
            "is not a class or function at the top level of a file or notebook",
            field="method",
            remedy="Move it there, or give a method directory.",
        )
    body = "\n\n".join(("from __future__ import annotations", *statements)) + "\n"
    atomic_write(root / name / "method_source.py", body)
    return atomic_write(
        root / name / MANIFEST, _MANIFEST.format(schema=SCHEMA, name=name, undeclared=UNDECLARED)
    ).parent


def _sources(module: Any) -> list[tuple[str, ast.stmt]]:
    """Each statement at the top of a module, or of all cells, with its text; the last first."""
    file = getattr(module, "__file__", None)
    # Of a cell there is no file, and so no time when it was changed.
    cells = [name for name, entry in linecache.cache.items() if len(entry) > 1 and not entry[1]]
    found: list[tuple[str, ast.stmt]] = []
    for name in [file] if file else cells:
        lines = linecache.getlines(name)
        with contextlib.suppress(SyntaxError):
            for node in ast.parse("".join(lines)).body:
                first = min(one.lineno for one in (node, *getattr(node, "decorator_list", ())))
                found.append(("".join(lines[first - 1 : node.end_lineno]).rstrip(), node))
    return found[::-1]


def _collect(
    name: str,
    module: Any,
    sources: list[tuple[str, ast.stmt]],
    statements: dict[str, None],
    seen: set[str],
) -> None:
    """Take the statement that binds a name, behind those that bind what it uses in turn."""
    seen.add(name)
    place = next((place for place, (_, node) in enumerate(sources) if name in _bound(node)), None)
    text = "" if place is None else sources[place][0]
    # A cell may have run again or changed it, so that it is not that of the last source.
    value = getattr(module, name, None)
    if text and value is not None and _is_plain(value):
        text = f"{name} = {value!r}"
    # What a package or a logger is set to belongs to the process, not to the method.
    elif text and not isinstance(value, types.ModuleType | logging.Logger):
        for change, node in sources[:place]:
            if name in _changed(node):
                raise UsageError(
                    f"uses {name!r}, which another statement changes: {one_line(change, 60)}",
                    field="method",
                    remedy=f"Make {name!r} in one statement, such as a call of a function.",
                )
    for used in sorted(_used(symtable.symtable(text, "method", "exec")) - seen):
        _collect(used, module, sources, statements, seen)
    if text:
        statements[text] = None


def _is_plain(value: Any, depth: int = 20) -> bool:
    """Whether Python reads a value from its `repr`: one of JSON, or tuples of them."""
    if type(value) in (list, tuple):
        return depth > 0 and all(_is_plain(one, depth - 1) for one in value)
    if type(value) is dict:
        return all(_is_plain(name, 0) for name in value) and _is_plain([*value.values()], depth)
    finite = type(value) is float and value - value == 0
    return value is None or type(value) in (bool, int, str) or finite


def _parts(node: ast.AST) -> Iterator[ast.AST]:
    """The parts of a statement that run with it: not the bodies of functions and classes."""
    waiting = [node]
    while waiting:
        part = waiting.pop()
        yield part
        if not isinstance(part, (*_DEFINITIONS, ast.Lambda)):
            waiting += ast.iter_child_nodes(part)


def _bound(node: ast.stmt) -> set[str]:
    """The names that a statement at the top level binds, whatever they were before."""
    names, changed = set(), set()
    for part in _parts(node):
        if isinstance(part, _DEFINITIONS):
            names.add(part.name)
        elif isinstance(part, ast.alias):
            names.add((part.asname or part.name).partition(".")[0])
        elif isinstance(part, ast.AugAssign):
            changed.add(part.target)
        elif isinstance(part, ast.Name) and type(part.ctx) is ast.Store and part not in changed:
            names.add(part.id)
    return names


def _changed(node: ast.stmt) -> set[str]:
    """The names whose values a statement at the top level changes, or calls a method of."""
    places: list[ast.expr] = []
    for part in _parts(node):
        if isinstance(part, ast.AugAssign):
            places.append(part.target)
        elif isinstance(part, ast.Attribute | ast.Subscript) and type(part.ctx) is not ast.Load:
            places.append(part)
        elif isinstance(part, ast.Expr) and isinstance(part.value, ast.Call):
            # A call without a dot changes nothing of the name itself.
            places += [part.value.func] if isinstance(part.value.func, ast.Attribute) else []
    return {place.id for place in map(_owner, places) if isinstance(place, ast.Name)}


def _owner(place: ast.expr) -> ast.expr:
    """The `a` of `a.b[0]` and of `a.b().c`; of `A().b` it is not `A`, but a new object."""
    while isinstance(place, ast.Attribute | ast.Subscript):
        place = place.value
        if isinstance(place, ast.Call) and isinstance(place.func, ast.Attribute):
            place = place.func
    return place


def _used(table: symtable.SymbolTable) -> set[str]:
    """The names of the module that a piece of source refers to."""
    top = table.get_type() == "module"
    symbols = [one for one in table.get_symbols() if one.is_referenced()]
    names = {one.get_name() for one in symbols if top or one.is_global()}
    return names.union(*map(_used, table.get_children()))
