"""Settings of a method as a dataclass, checked when they are read.

For authors of methods: `settings_from(MySettings, table)` turns a preset's table, with the
overrides of the command line, into a frozen dataclass, or says which name or value is wrong.
`settings = "module:MySettings"` in `method.toml` gives its names to the toolkit, which parses the
source (`class_settings`) and refuses a wrong name before anything runs.
"""

from __future__ import annotations

import ast
import math
from collections.abc import Mapping, Sequence
from functools import lru_cache
from pathlib import Path
from typing import Any, TypeVar

from hwp_bench.base.errors import BadMethod, UsageError
from hwp_bench.base.files import inside
from hwp_bench.base.packages import PACKAGES
from hwp_bench.base.records import choice, number, parse_record, unfold

__all__ = ["check_source", "choice", "class_settings", "number", "settings_from", "source_path"]

Settings = TypeVar("Settings")

# Most classes on the way from a settings class to a table in it, and most bytes of a source.
_MOST_CLASSES, _MOST_SOURCE = 16, 4 << 20


def settings_from(cls: type[Settings], values: Mapping[str, Any], where: str) -> Settings:
    """Check a table of settings.

    A field that is itself a dataclass reads a table of its own; `name.field` reaches into it,
    and so does `--set name.field=value`.
    """
    return parse_record(cls, unfold(values), where=where, error=BadMethod, numbers=(0.0, math.inf))


def check_source(value: str, field: str, words: Sequence[str], kinds: Sequence[str]) -> None:
    """Refuse a setting that is neither one of some words nor `KIND:PATH`."""
    kind, colon, place = value.partition(":")
    if value in words or (colon and place and kind in kinds):
        return
    known = [*words, *(f"{kind}:PATH" for kind in kinds)]
    raise UsageError(f"is {value[:100]!r}", field=field, remedy=f"Use {' or '.join(known)}.")


def source_path(value: str) -> str | None:
    """Return the path in a setting's value `KIND:PATH`; None where it is a word."""
    _, colon, place = value.partition(":")
    return place if colon else None


def class_settings(root: Path, reference: str) -> list[str]:
    """Return the names of the settings that a dataclass declares, without importing it.

    The source is parsed, never run. `module` is looked for in the method's folder first, then
    among the packages of the toolkit. Each field is a setting, those of base classes come first;
    a field whose type is itself a dataclass is a table of settings (`rates.dpd`). Classes are
    followed through `from module import Name` and `import module`, also by another name. A type
    that is found nowhere is one setting, which stands for everything below it.
    """
    module, _, name = reference.partition(":")
    return _ClassReader(root, reference).names(module, name)


class _ClassReader:
    """Reads settings classes from source files, each file once."""

    def __init__(self, root: Path, reference: str) -> None:
        self._root, self._reference = root, reference
        self._sources: dict[str, ast.Module | None] = {}

    def names(self, module: str, name: str) -> list[str]:
        found = self._find(module, name)
        if found is None:
            raise self._wrong(f"{self._reference!r} is not there")
        if not _is_dataclass(found[1]):
            raise self._wrong(f"{self._reference!r} is not a dataclass")
        return self._names_of(*found, ())

    def _wrong(self, problem: str) -> BadMethod:
        return BadMethod(
            problem,
            where=self._root,
            field="settings",
            remedy="Name a dataclass in the method's folder or the toolkit: module:Class.",
        )

    def _names_of(self, module: str, found: ast.ClassDef, above: tuple[str, ...]) -> list[str]:
        """The names of a class's fields; `above` holds the classes that are being read."""
        place = f"{module}:{found.name}"
        if place in above or len(above) > _MOST_CLASSES:
            raise self._wrong(f"{place!r} is a table of itself")
        above = (*above, place)
        names: dict[str, None] = {}
        for base in found.bases:
            inherited = self._class_of(module, base)
            if inherited is not None and _is_dataclass(inherited[1]):
                names |= dict.fromkeys(self._names_of(*inherited, above))
        for item in found.body:
            if not isinstance(item, ast.AnnAssign) or not isinstance(item.target, ast.Name):
                continue
            field, annotation = item.target.id, _without_quotes(item.annotation)
            if "ClassVar" in ast.unparse(annotation):
                continue
            # A class of its own may declare again what its base declares.
            names = {key: None for key in names if key.partition(".")[0] != field}
            table = self._class_of(module, annotation)
            if table is not None and _is_dataclass(table[1]):
                below = self._names_of(*table, above)
                names |= {f"{field}.{name}": None for name in below}
            else:
                names[field] = None
        return list(names)

    def _class_of(self, module: str, node: ast.expr) -> tuple[str, ast.ClassDef] | None:
        """The class that an expression in a module names, and the module where it stands."""
        if isinstance(node, ast.Name):
            return self._find(module, node.id)
        if isinstance(node, ast.Attribute):
            source, owner = self._source(module), ast.unparse(node.value)
            imported = _imports(source).get(owner) if source else None
            return self._find(".".join(filter(None, imported)), node.attr) if imported else None
        return None

    def _find(self, module: str, name: str, steps: int = 0) -> tuple[str, ast.ClassDef] | None:
        """The class of a name in a module, and the module that defines it."""
        source = self._source(module)
        if source is None or steps > _MOST_CLASSES:
            return None
        for item in source.body:
            if isinstance(item, ast.ClassDef) and item.name == name:
                return module, item
        imported = _imports(source).get(name)
        if imported is None or not imported[1]:
            return None
        return self._find(*imported, steps + 1)

    def _source(self, module: str) -> ast.Module | None:
        if module not in self._sources:
            self._sources[module] = self._parse(module)
        return self._sources[module]

    def _parse(self, module: str) -> ast.Module | None:
        place = module.replace(".", "/")
        for folder in (self._root, PACKAGES):
            for name in (f"{place}.py", f"{place}/__init__.py"):
                path = inside(folder, name)
                if not path.is_file():
                    continue
                if path.stat().st_size > _MOST_SOURCE:
                    raise self._wrong(f"{name} is larger than {_MOST_SOURCE >> 20} MiB")
                try:
                    return ast.parse(path.read_bytes())
                except (OSError, SyntaxError, ValueError, RecursionError, MemoryError) as error:
                    raise self._wrong(f"{name} cannot be parsed ({error})") from error
        return None


@lru_cache(maxsize=64)
def _imports(source: ast.Module) -> dict[str, tuple[str, str]]:
    """Module and name (empty for a whole module) of what a source imports, by the name it gets."""
    found = {}
    for item in ast.walk(source):
        if isinstance(item, ast.ImportFrom) and item.module and not item.level:
            for one in item.names:
                found[one.asname or one.name] = (item.module, one.name)
        elif isinstance(item, ast.Import):
            for one in item.names:
                found[one.asname or one.name] = (one.name, "")
    return found


def _is_dataclass(found: ast.ClassDef) -> bool:
    marks = [mark.func if isinstance(mark, ast.Call) else mark for mark in found.decorator_list]
    return any(ast.unparse(mark).rpartition(".")[2] == "dataclass" for mark in marks)


def _without_quotes(annotation: ast.expr) -> ast.expr:
    """The type in quotes; of `Annotated[T, ...]` and of `T | None` the T."""
    if isinstance(annotation, ast.Constant) and isinstance(annotation.value, str):
        try:
            annotation = ast.parse(annotation.value, mode="eval").body
        except SyntaxError:
            return annotation
    if isinstance(annotation, ast.Subscript) and ast.unparse(annotation.value).endswith(
        "Annotated"
    ):
        inner = annotation.slice
        return _without_quotes(inner.elts[0] if isinstance(inner, ast.Tuple) else inner)
    if isinstance(annotation, ast.BinOp) and isinstance(annotation.op, ast.BitOr):
        sides = [annotation.left, annotation.right]
        kept = [side for side in sides if ast.unparse(side) != "None"]
        return _without_quotes(kept[0]) if len(kept) == 1 else annotation
    return annotation
