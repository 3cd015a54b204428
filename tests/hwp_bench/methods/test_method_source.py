"""A class or function as a method directory. Oracle: what the written module does when it runs."""

from __future__ import annotations

import importlib.util
import linecache
import math as mathematics
import sys
import types
import xml.dom.minidom
from pathlib import Path
from typing import Any

import pytest

from hwp_bench.base.errors import UsageError
from hwp_bench.methods.manifest import read_manifest
from hwp_bench.methods.source import write_method

LEVEL = 2 * 0.25
unrelated = object()


def doubled(value: float) -> float:
    return 2.0 * value + (0.0 if value > 0 else halved(value))


def halved(value: float) -> float:
    return doubled(value) / mathematics.tau


class Base:
    name = xml.dom.minidom.__name__


class Mine(Base):
    """Uses names of its module; `unrelated` is its own."""

    def __init__(self, settings: dict[str, Any], seed: int = 0) -> None:
        unrelated = LEVEL
        self.value = doubled(unrelated)


def make(settings: dict[str, Any], seed: int) -> Mine:
    return Mine(settings, seed)


def run(folder: Path, name: str) -> Any:
    """Import the module that was written, and make the method."""
    entry = str(read_manifest(folder).entry.python)
    place = importlib.util.spec_from_file_location("written", folder / "method_source.py")
    assert place is not None
    assert place.loader is not None
    module = importlib.util.module_from_spec(place)
    place.loader.exec_module(module)
    assert entry == f"method_source:{name}"
    return getattr(module, name)({}, 0)


@pytest.mark.parametrize("factory", [Mine, make], ids=lambda one: one.__name__)
def test_the_source_takes_along_what_it_uses(factory: Any, tmp_path: Path) -> None:
    folder = write_method(factory, tmp_path)
    assert folder.name == factory.__name__
    made = run(folder, factory.__name__)
    assert (made.value, made.name) == (1.0, "xml.dom.minidom")
    source = (folder / "method_source.py").read_text("utf-8")
    assert "unrelated = object()" not in source
    assert "pytest" not in source
    # The same source gives the same directory, and so the same digest.
    again = write_method(factory, tmp_path / "again")
    assert read_manifest(again).digest == read_manifest(folder).digest
    assert read_manifest(folder).training.kinds == ("private",)


def cells(*sources: str) -> Any:
    """Run cells as a notebook does: their source is kept, and no file is behind them."""
    module = types.ModuleType("notebook_of_the_test")
    sys.modules[module.__name__] = module
    for name in [name for name in linecache.cache if name.endswith(" of the test>")]:
        del linecache.cache[name]
    for number, text in enumerate(sources):
        name = f"<cell {number} of the test>"
        linecache.cache[name] = (len(text), None, text.splitlines(keepends=True), name)
        exec(compile(text, name, "exec"), module.__dict__)
    return module


def test_cells_of_a_notebook_are_source_and_the_last_one_counts(tmp_path: Path) -> None:
    notebook = cells(
        "import math\nlevel = 1.0\n",
        "class Mine:\n    def __init__(self, settings, seed):\n        self.value = 0.0\n",
        "level = 3.0\n",
        "class Mine:\n    def __init__(self, settings, seed):\n"
        "        self.value = level + math.floor(0.5)\n",
    )
    made = run(write_method(notebook.Mine, tmp_path), "Mine")
    assert made.value == notebook.Mine({}, 0).value == 3.0
    # The first cell runs again.
    notebook.level = 1.0
    assert run(write_method(notebook.Mine, tmp_path / "again"), "Mine").value == 1.0


USES = "class Mine:\n    def __init__(self, settings, seed):\n        self.value = {}\n"


@pytest.mark.parametrize(
    ("lines", "used"),
    [
        ('CONFIG = {"steps": 100}\nCONFIG["steps"] = 500\n', "CONFIG"),
        ('NAMES = ["a"]\nNAMES.append("b")\n', "NAMES"),
        ("TOTAL = [1]\nTOTAL += [2]\n", "TOTAL"),
        ("SIZES = ((1, 2.5), {3: [None]})\nSIZES[1][3].append(True)\n", "SIZES"),
        ("COUNT = 1\nCOUNT += 1\n", "COUNT"),
        ("if True:\n    def helper(x):\n        y = x\n        return y\n", "helper(3)"),
        ("try:\n    class Part:\n        size = 2\nfinally:\n    pass\n", "Part.size"),
        # A package and a logger are set for the process; a new object is not the class.
        ("import math\nmath.floor(2.5)\n", "math.floor(1.5)"),
        ('import logging\nlog = logging.getLogger("x")\nlog.debug("made")\n', "log.name"),
        ("class Part:\n    size = 2\n    def grow(self): pass\nPart().grow()\n", "Part.size"),
        # What changed it before it was made anew does not count.
        ("part = set()\npart.add(1)\npart = {2, 3}\n", "part"),
    ],
)
def test_names_have_the_values_that_they_have_here(lines: str, used: str, tmp_path: Path) -> None:
    notebook = cells(lines, USES.format(used))
    made = run(write_method(notebook.Mine, tmp_path), "Mine")
    assert made.value == notebook.Mine({}, 0).value


@pytest.mark.parametrize(
    "change",
    ["part.x = 1", "part[0] = 1", "part |= {2}", "part.a().b(1)", "for n in 1, 2: part.add(n)"],
)
def test_a_value_that_another_statement_changes_is_refused(change: str, tmp_path: Path) -> None:
    notebook = cells(
        "class Part:\n    def __getattr__(self, name): return lambda *_: self\n"
        "    def __setitem__(self, place, value): pass\n    def __ior__(self, more): return self\n"
        "part = Part()\n",
        USES.format("part"),
        change + "\n",
    )
    with pytest.raises(UsageError, match=r"^method: uses 'part', which another statement changes"):
        write_method(notebook.Mine, tmp_path)


def test_what_has_no_source_of_its_own_is_refused(tmp_path: Path) -> None:
    class Local:
        pass

    for value in (Local, Mine({}), lambda settings, seed: None):
        with pytest.raises(UsageError, match="method: is not a class or function at the top level"):
            write_method(value, tmp_path)
    module = types.ModuleType("without_source")
    sys.modules[module.__name__] = module
    exec("class Unseen: pass", module.__dict__)
    with pytest.raises(UsageError, match="at the top level of a file or notebook"):
        write_method(module.Unseen, tmp_path)
    assert list(tmp_path.iterdir()) == []
