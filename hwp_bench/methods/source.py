"""A class or function of Python as a method directory: its source, and what the source names.

Functions, classes, imports and constants that it uses are taken from its own file, or from the
cells of its notebook. Everything else has to be installed.
"""

from __future__ import annotations

import ast
import importlib.util
import linecache
import symtable
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from hwp_bench.base.errors import UsageError
from hwp_bench.base.files import atomic_write
from hwp_bench.methods.manifest import MANIFEST, SCHEMA

#: Name of the module in the directory.
_MODULE = "method_source"
# The class says nothing of its training, so that a result must not say "none".
_MANIFEST = """schema = "{schema}"
name = "{name}"
training = {{private = ["not declared"]}}
[entry]
python = "{module}:{name}"
"""


def write_method(factory: Any, root: Path) -> Path:
    """Write the method directory of a class or function into a folder; returns the directory.

    Args:
        factory: what `entry.python` of a `method.toml` would name: called with `settings` and
            `seed`, it returns an object with `fit`.
        root: the folder; the directory in it has the name of the class.

    Raises:
        UsageError: it is not defined at the top level of a file or notebook, or its source is not
            known.
    """
    name = getattr(factory, "__name__", "")
    module = sys.modules.get(getattr(factory, "__module__", None) or "")
    if module is None or not name.isidentifier() or getattr(module, name, None) is not factory:
        raise _wrong("is not a class or function at the top level of a file or notebook")
    trees = list(_sources(module))
    statements: dict[str, None] = {}
    if not _collect(name, trees, module.__package__ or "", statements, set()):
        raise _wrong(f"has no source that can be read: {name} of {module.__name__}")
    body = "\n\n".join(("from __future__ import annotations", *statements)) + "\n"
    atomic_write(root / name / f"{_MODULE}.py", body)
    text = _MANIFEST.format(schema=SCHEMA, name=name, module=_MODULE)
    return atomic_write(root / name / MANIFEST, text).parent


def _wrong(problem: str) -> UsageError:
    remedy = "Give a class or function (not an instance) of a file, or a method directory."
    return UsageError(problem, field="method", remedy=remedy)


def _sources(module: Any) -> Iterator[tuple[str, list[ast.stmt]]]:
    """Text and statements of the file of a module, or of all cells that ran, the last first."""
    file = getattr(module, "__file__", None)
    # Of a cell there is no file, and so no time when it was changed.
    cells = [name for name, entry in linecache.cache.items() if len(entry) > 1 and not entry[1]]
    for name in [file] if file else reversed(cells):
        text = "".join(linecache.getlines(name))
        try:
            yield text, ast.parse(text).body
        except SyntaxError:
            continue


def _collect(
    name: str,
    trees: list[tuple[str, list[ast.stmt]]],
    package: str,
    statements: dict[str, None],
    seen: set[str],
) -> bool:
    """Take the statement that binds a name, behind those that bind what it uses in turn."""
    if name in seen:
        return True
    seen.add(name)
    for text, body in trees:
        for node in reversed(body):
            if name not in _bound(node):
                continue
            first = min([node, *getattr(node, "decorator_list", ())], key=lambda one: one.lineno)
            code = "\n".join(text.split("\n")[first.lineno - 1 : node.end_lineno])
            if isinstance(node, ast.ImportFrom) and node.level:
                place = "." * node.level + (node.module or "")
                node.module, node.level = importlib.util.resolve_name(place, package), 0
                code = ast.unparse(node)
            for used in _used(symtable.symtable(code, "method", "exec")):
                _collect(used, trees, package, statements, seen)
            statements[code] = None
            return True
    return False


def _bound(node: ast.stmt) -> set[str]:
    """The names that a statement at the top level binds."""
    if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef | ast.ClassDef):
        return {node.name}
    names = set()
    for part in ast.walk(node):
        if isinstance(part, ast.Name) and isinstance(part.ctx, ast.Store):
            names.add(part.id)
        elif isinstance(part, ast.alias):
            names.add((part.asname or part.name).partition(".")[0])
    return names


def _used(table: symtable.SymbolTable) -> set[str]:
    """The names of the module that a piece of source refers to."""
    names = {
        symbol.get_name()
        for symbol in table.get_symbols()
        if symbol.is_referenced() and (symbol.is_global() or table.get_type() == "module")
    }
    return names.union(*map(_used, table.get_children()))
