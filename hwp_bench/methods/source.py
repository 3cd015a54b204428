"""A class or function of Python as a method directory: its source, and what the source names.

Functions, classes, imports and constants that it uses are taken from its own file, or from the
cells of its notebook. Everything else has to be installed.
"""

from __future__ import annotations

import ast
import contextlib
import linecache
import symtable
import sys
from pathlib import Path
from typing import Any

from hwp_bench.base.errors import UsageError
from hwp_bench.base.files import atomic_write
from hwp_bench.methods.manifest import MANIFEST, SCHEMA

# The class says nothing of its training, so that a result must not say "none".
_MANIFEST = """schema = "{schema}"
name = "{name}"
training = {{private = ["not declared"]}}
[entry]
python = "method_source:{name}"
"""


def write_method(factory: Any, root: Path) -> Path:
    """Write the method directory of what `entry.python` would name into a folder; returns it.

    Raises:
        UsageError: it is not defined at the top level of a file or notebook.
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
    return atomic_write(root / name / MANIFEST, _MANIFEST.format(schema=SCHEMA, name=name)).parent


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
    text = next((text for text, node in sources if name in _bound(node)), "")
    # A cell may have run again, so that a number is not that of the last source.
    value = getattr(module, name, None)
    if text and (type(value) in (bool, int, str) or (type(value) is float and value - value == 0)):
        text = f"{name} = {value!r}"
    for used in sorted(_used(symtable.symtable(text, "method", "exec")) - seen):
        _collect(used, module, sources, statements, seen)
    if text:
        statements[text] = None


def _bound(node: ast.stmt) -> set[str]:
    """The names that a statement at the top level binds."""
    if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef | ast.ClassDef):
        return {node.name}
    parts = list(ast.walk(node))
    stored = {one.id for one in parts if isinstance(one, ast.Name) and type(one.ctx) is ast.Store}
    aliases = (one for one in parts if isinstance(one, ast.alias))
    return stored | {(one.asname or one.name).partition(".")[0] for one in aliases}


def _used(table: symtable.SymbolTable) -> set[str]:
    """The names of the module that a piece of source refers to."""
    top = table.get_type() == "module"
    symbols = [one for one in table.get_symbols() if one.is_referenced()]
    names = {one.get_name() for one in symbols if top or one.is_global()}
    return names.union(*map(_used, table.get_children()))
