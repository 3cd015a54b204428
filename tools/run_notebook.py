"""Runs the code of a notebook in this interpreter, and stores what its cells show.

    python tools/run_notebook.py docs/notebooks/avatar.ipynb

It needs no Jupyter: a cell's output is what it prints, and the value of its last line where that is
an expression. Run it in a folder that the notebook may write to.
"""

from __future__ import annotations

import argparse
import ast
import base64
import contextlib
import io
import json
import linecache
import os
import sys
import types
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any


def code_cells(notebook: Mapping[str, Any]) -> Iterator[dict[str, Any]]:
    """Every cell of code, in order."""
    yield from (cell for cell in notebook["cells"] if cell["cell_type"] == "code")


def run_cell(source: str, names: dict[str, Any], title: str) -> tuple[str, Any]:
    """Run one cell.

    Args:
        source: its text.
        names: of the notebook so far; changed.
        title: for tracebacks.

    Returns:
        What it prints, and the value of its last line (None where that is not an expression).
    """
    # As IPython does: the source of a class of the cell can be found.
    linecache.cache[title] = (len(source), None, source.splitlines(keepends=True), title)
    tree = ast.parse(source, title)
    last = tree.body.pop() if tree.body and isinstance(tree.body[-1], ast.Expr) else None
    printed = io.StringIO()
    with contextlib.redirect_stdout(printed):
        exec(compile(tree, title, "exec"), names)
        value = None
        if last is not None:
            value = eval(compile(ast.Expression(last.value), title, "eval"), names)
    return printed.getvalue(), value


def outputs_of(printed: str, value: Any, count: int) -> list[dict[str, Any]]:
    """Return the outputs that a notebook stores of a cell."""
    outputs: list[dict[str, Any]] = []
    if printed:
        outputs.append({"output_type": "stream", "name": "stdout", "text": printed})
    if value is not None:
        data: dict[str, Any] = {"text/plain": repr(value)}
        if hasattr(value, "_repr_mimebundle_"):
            data = value._repr_mimebundle_()
        elif hasattr(value, "_repr_png_"):
            data["image/png"] = base64.b64encode(value._repr_png_()).decode()
        elif hasattr(value, "_repr_html_"):
            data["text/html"] = value._repr_html_()
        outputs.append(
            {
                "output_type": "execute_result",
                "execution_count": count,
                "metadata": {},
                "data": data,
            }
        )
    return outputs


def run_notebook(notebook: dict[str, Any], changes: Mapping[str, Any] | None = None) -> None:
    """Run every cell of code, and put its outputs into the notebook.

    Args:
        notebook: as its JSON; changed.
        changes: names that are set after the cell with the tag `parameters`.
    """
    before, main_module = sys.modules["__main__"], types.ModuleType("__main__")
    sys.modules["__main__"] = main_module
    names = vars(main_module)
    try:
        for count, cell in enumerate(code_cells(notebook), start=1):
            title = f"<cell {count} of {id(main_module)}>"
            printed, value = run_cell("".join(cell["source"]), names, title)
            if "parameters" in cell["metadata"].get("tags", ()):
                names.update(changes or {})
            cell["execution_count"] = count
            cell["outputs"] = outputs_of(printed, value, count)
    finally:
        sys.modules["__main__"] = before


def main() -> None:
    """Run a notebook and write it."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("notebook", type=Path)
    path = parser.parse_args().notebook
    notebook = json.loads(path.read_text("utf-8"))
    run_notebook(notebook)
    partial = path.with_name(f".{path.name}")
    partial.write_text(json.dumps(notebook, indent=1, ensure_ascii=False) + "\n", "utf-8")
    os.replace(partial, path)


if __name__ == "__main__":
    main()
