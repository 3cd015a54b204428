"""Count the house: modules, lines, settings, and what a reader opens. `python tools/house.py`.

Run it in the root of a checkout with the package installed. Modules and lines are those of
`hwp_bench`, `wildghand` and `baselines`; `__init__` files count as lines and not as modules. The
walks are those of docs/architecture.md.
"""

from __future__ import annotations

import argparse
import ast
import dataclasses
import io
import json
import re
import sys
import tokenize
import tomllib
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
PACKAGES = ("hwp_bench", "wildghand", "baselines")
PAGE = ROOT / "docs" / "architecture.md"
_NO_CODE = {
    tokenize.COMMENT,
    tokenize.NL,
    tokenize.NEWLINE,
    tokenize.INDENT,
    tokenize.DEDENT,
    tokenize.ENCODING,
    tokenize.ENDMARKER,
}


def count_code(text: str) -> int:
    """Lines that hold code: no import, docstring, comment or blank line."""
    left_out: set[int] = set()
    for node in ast.walk(ast.parse(text)):
        if isinstance(node, ast.Import | ast.ImportFrom):
            left_out.update(range(node.lineno, (node.end_lineno or 0) + 1))
        first = getattr(node, "body", None)
        if isinstance(first, list) and first and isinstance(first[0], ast.Expr):
            value = first[0].value
            if isinstance(value, ast.Constant) and isinstance(value.value, str):
                left_out.update(range(first[0].lineno, (first[0].end_lineno or 0) + 1))
    held: set[int] = set()
    for token in tokenize.generate_tokens(io.StringIO(text).readline):
        if token.type not in _NO_CODE:
            held.update(range(token.start[0], token.end[0] + 1))
    return len(held - left_out)


def count_leaves(settings: type) -> int:
    """Settings of a dataclass, those of the tables within it counted one by one."""
    made = settings()
    return sum(
        count_leaves(type(getattr(made, field.name)))
        if dataclasses.is_dataclass(getattr(made, field.name))
        else 1
        for field in dataclasses.fields(made)
    )


def count_imports(path: Path) -> int:
    """Modules of the project that a file imports."""
    found: set[str] = set()
    for node in ast.walk(ast.parse(path.read_text("utf-8"))):
        if isinstance(node, ast.ImportFrom) and node.module:
            found.add(node.module)
        elif isinstance(node, ast.Import):
            found.update(alias.name for alias in node.names)
    return sum(name.split(".")[0] in PACKAGES for name in found)


def count_attributes(path: Path, name: str) -> int:
    """Attributes that the methods of a class set on themselves."""
    tree = ast.parse(path.read_text("utf-8"))
    (made,) = (n for n in ast.walk(tree) if isinstance(n, ast.ClassDef) and n.name == name)
    return len(
        {
            node.attr
            for node in ast.walk(made)
            if isinstance(node, ast.Attribute)
            and isinstance(node.ctx, ast.Store)
            and isinstance(node.value, ast.Name)
            and node.value.id == "self"
        }
    )


def walks() -> dict[str, int]:
    """Modules in each walk of docs/architecture.md, by the command that it follows."""
    sections = re.split(r"^## ", PAGE.read_text("utf-8"), flags=re.MULTILINE)[1:]
    return {
        section.splitlines()[0]: len(re.findall(r"^\| *\d+ *\|", section, re.MULTILINE))
        for section in sections
        if "walk" in section.splitlines()[0].lower()
    }


def count() -> dict[str, int]:
    """Every number of the house by its name."""
    from wildghand.model.settings import WildGHandSettings

    files = [path for package in PACKAGES for path in sorted((ROOT / package).rglob("*.py"))]
    texts = {path: path.read_text("utf-8") for path in files}
    modules = [path for path in files if path.name != "__init__.py"]
    rooms = {path.parent for path in modules}
    fit = ROOT / "wildghand" / "fitting" / "fit.py"
    method = tomllib.loads((ROOT / "wildghand" / "method.toml").read_text("utf-8"))
    tests = sorted((ROOT / "tests").rglob("*.py"))
    return {
        "modules": len(modules),
        "folders with modules": len(rooms),
        "lines": sum(len(text.splitlines()) for text in texts.values()),
        "lines of code": sum(count_code(text) for text in texts.values()),
        "lines of tests": sum(len(path.read_text("utf-8").splitlines()) for path in tests),
        "longest file": max(len(text.splitlines()) for text in texts.values()),
        "imports from the project in fit.py": count_imports(fit),
        "attributes of Fit": count_attributes(fit, "Fit"),
        "settings of the method": count_leaves(WildGHandSettings),
        "switches of the method": len(method.get("switches", {})),
        **{f"modules in: {name}": number for name, number in walks().items()},
    }


def main() -> int:
    """Print the numbers."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--json", action="store_true", help="print JSON")
    found = count()
    if parser.parse_args().json:
        json.dump(found, sys.stdout, indent=1)
        print()
    else:
        for name, number in found.items():
            print(f"{number:8,}  {name}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
