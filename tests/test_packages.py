"""Packages import only what lies below them. Oracle: every import statement of the tree.

`docs/architecture.md` states the layers: its lists of packages are in order, from the lowest to the
highest, and this test reads them. It also follows the walks of the page from import to import.
"""

from __future__ import annotations

import ast
import functools
import re
from collections.abc import Iterator
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
PAGE = ROOT / "docs" / "architecture.md"
PACKAGES = ("hwp_bench", "wildghand")


def modules() -> dict[str, Path]:
    """Every module of the packages, by dotted name."""
    found = {}
    for package in PACKAGES:
        for path in (ROOT / package).rglob("*.py"):
            name = ".".join(path.relative_to(ROOT).with_suffix("").parts)
            found[name.removesuffix(".__init__")] = path
    return found


def imports(name: str, path: Path, known: dict[str, Path]) -> Iterator[str]:
    """Every module of the packages that a module imports: at its top, in functions, for types."""
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        targets: list[str] = []
        if isinstance(node, ast.Import):
            targets = [alias.name for alias in node.names]
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{name}: a relative import"
            module = node.module or ""
            both = [f"{module}.{alias.name}" for alias in node.names]
            targets = [one if one in known else module for one in both]
        yield from (target for target in targets if target.split(".")[0] in PACKAGES)


def layers(package: str) -> list[str]:
    """The parts of a package in the order of the page's list, lowest first."""
    rows = re.findall(rf"^- `{package}/(\w+)`", PAGE.read_text("utf-8"), re.MULTILINE)
    assert len(rows) == len(set(rows))
    return rows


def part(name: str) -> str:
    """The part of a module: `base` of `hwp_bench.base.errors`; `` of a package's `__init__`."""
    return [*name.split("."), ""][1]


MODULES = modules()


@functools.cache
def every_import() -> dict[str, list[str]]:
    """What each module imports; read by the first test that asks, and not by every worker."""
    return {name: sorted(set(imports(name, path, MODULES))) for name, path in MODULES.items()}


@pytest.mark.parametrize("package", PACKAGES)
def test_the_page_names_every_room(package: str) -> None:
    there = {part(name) for name in MODULES if name.split(".")[0] == package} - {""}
    assert set(layers(package)) == there


@pytest.mark.parametrize("package", PACKAGES)
def test_packages_import_only_what_lies_below(package: str) -> None:
    rank = {name: place for place, name in enumerate(layers(package))}
    wrong = [
        f"{name} imports {target}"
        for name, targets in every_import().items()
        for target in targets
        if name.split(".")[0] == target.split(".")[0] == package
        and part(name)
        and part(target)
        and rank[part(name)] < rank[part(target)]
    ]
    assert wrong == []


def test_the_rasterizer_imports_nothing_of_the_method() -> None:
    allowed = ("wildghand.splat", "hwp_bench.base", "hwp_bench.stability")
    wrong = [
        f"{name} imports {target}"
        for name, targets in every_import().items()
        for target in targets
        if name.startswith("wildghand.splat") and not target.startswith(allowed)
    ]
    assert wrong == []


def test_no_module_lies_loose_in_the_method() -> None:
    assert [path.name for path in (ROOT / "wildghand").glob("*.py")] == ["__init__.py"]


def circles(graph: dict[str, set[str]]) -> list[list[str]]:
    """Circles that a walk along the edges of a graph comes upon; none means there is none."""
    state: dict[str, str] = {}
    found: list[list[str]] = []

    def visit(name: str, path: list[str]) -> None:
        state[name] = "open"
        for target in sorted(graph.get(name, set())):
            if state.get(target) == "open":
                found.append([*path[path.index(target) :], target])
            elif target not in state:
                visit(target, [*path, target])
        state[name] = "done"

    for name in graph:
        if name not in state:
            visit(name, [name])
    return found


def test_the_search_for_circles_finds_one() -> None:
    assert circles({"a": {"b"}, "b": {"c"}, "c": {"a"}}) == [["a", "b", "c", "a"]]
    assert circles({"a": {"b", "c"}, "b": {"c"}}) == []


def test_no_modules_import_one_another_in_a_circle() -> None:
    # What is imported for types, or when a function runs, counts too. A package's `__init__`
    # that gives out the names of its modules stands above them.
    graph = {name: {to for to in targets if to != name} for name, targets in every_import().items()}
    assert circles(graph) == []


@pytest.mark.parametrize(
    "parent", sorted({n.rpartition(".")[0] for n in MODULES if n.count(".") > 1})
)
def test_parts_of_a_package_do_not_import_one_another_in_a_circle(parent: str) -> None:
    def part(name: str) -> str:
        return (
            name.removeprefix(f"{parent}.").split(".")[0] if name.startswith(f"{parent}.") else ""
        )

    graph: dict[str, set[str]] = {}
    for name, targets in every_import().items():
        if part(name):
            others = {part(target) for target in targets} - {"", part(name)}
            graph.setdefault(part(name), set()).update(others)
    assert circles(graph) == []


@pytest.mark.parametrize("package", PACKAGES)
def test_no_public_name_of_a_package_is_also_a_room(package: str) -> None:
    # Importing a part sets it as an attribute of the package, in place of the public name.
    public = set(__import__(package).__all__)
    assert public.isdisjoint(part(name) for name in MODULES if name.split(".")[0] == package)


#: Most words of the page, and most modules of its walks.
WORDS, STEPS = 1300, {"hwp-bench evaluate": 18, "wildghand fit": 25}


def walk(command: str) -> list[str]:
    """The files that the page's walk through a command names, in order."""
    (section,) = (
        part
        for part in re.split(r"^## ", PAGE.read_text("utf-8"), flags=re.MULTILINE)
        if part.startswith(f"A walk through `{command}")
    )
    return re.findall(r"^\d+\. `([\w/.-]+\.py)`", section, re.MULTILINE)


def leads_to(name: str) -> set[str]:
    """Modules that one imports, through a package's `__init__` too, or names in a string."""
    found = set(every_import()[name])
    for target in list(found):
        if MODULES[target].name == "__init__.py":
            found |= set(every_import()[target])
    text = MODULES[name].read_text("utf-8")
    # Commands, workers and entries of methods are loaded by name.
    return found | {
        other
        for other in MODULES
        if other in text or re.search(rf"[\"{{.]{other.rpartition('.')[2]}[\"}}:]", text)
    }


def test_the_page_is_short() -> None:
    assert len(PAGE.read_text("utf-8").split()) <= WORDS


@pytest.mark.parametrize("command", STEPS)
def test_a_walk_goes_from_import_to_import(command: str) -> None:
    files = walk(command)
    assert 10 <= len(files) <= STEPS[command]
    names = [".".join(Path(file).with_suffix("").parts) for file in files]
    assert [file for file in files if not (ROOT / file).is_file()] == []
    behind = set()
    for number, name in enumerate(names):
        assert not number or name in behind, f"nothing before {name} leads to it"
        behind |= leads_to(name)
