"""A table and its formats: Markdown, LaTeX, CSV, JSON, terminal."""

from __future__ import annotations

import csv
import io
import json
import sys
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from hwp_bench.base.console import encoding_of
from hwp_bench.base.files import atomic_write
from hwp_bench.base.terminal_tables import WIDTH, table_lines

#: Formats of a table by file ending.
FORMATS = ("md", "tex", "csv", "json")

Cell = str | float | int | None


@dataclass(frozen=True)
class Column:
    """One column of a table."""

    #: Heading; an arrow for the better direction is added by `heading`.
    title: str
    #: Digits after the decimal point of numbers.
    digits: int = 2
    #: True or False where larger or smaller is better; None for text and counts.
    higher_is_better: bool | None = None
    #: Text over a group of columns; neighbours of equal text share it.
    group: str = ""

    @property
    def arrow(self) -> str:
        """A space and the arrow of the better direction; empty without one."""
        return {True: " ↑", False: " ↓", None: ""}[self.higher_is_better]

    @property
    def heading(self) -> str:
        """The title with its arrow."""
        return self.title + self.arrow

    @property
    def name(self) -> str:
        """The group and the title, where groups have no line of their own."""
        parts = (self.title,) if self.group == self.title else (self.group, self.title)
        return " ".join(parts).strip()


@dataclass(frozen=True)
class Table:
    """Rows under columns; a cell is a text, a number, or None for "not measured"."""

    #: Its caption.
    caption: str
    #: Its columns.
    columns: tuple[Column, ...]
    #: Its rows, as long as `columns`.
    rows: tuple[tuple[Cell, ...], ...]
    #: Lines under the table.
    notes: tuple[str, ...] = ()
    #: Rank the rows of each scored column (best bold, second underlined).
    ranked: bool = True
    #: Rows at which a further block begins; rows are ranked within their block.
    breaks: tuple[int, ...] = ()
    #: Rows that are shown but never ranked, such as published numbers.
    unranked: frozenset[int] = frozenset()

    def block(self, row: int) -> list[int]:
        """Return the ranked rows of the block that a row is in."""
        edges = [0, *self.breaks, len(self.rows)]
        start = max(edge for edge in edges if edge <= row)
        stop = min(edge for edge in edges if edge > row)
        return [index for index in range(start, stop) if index not in self.unranked]

    def text(self, row: int, column: int) -> str:
        """Return a cell as it is printed."""
        value = self.rows[row][column]
        if value is None:
            return "–"
        if isinstance(value, float):
            return f"{value:.{self.columns[column].digits}f}"
        return str(value)

    def rank(self, row: int, column: int) -> int | None:
        """Return 0 for the best and 1 for the second best of a scored column, else None.

        Equal printed values share a rank; a single value in a block has none.
        """
        better = self.columns[column].higher_is_better
        value = self.rows[row][column]
        if not self.ranked or better is None or not isinstance(value, float):
            return None
        block = self.block(row)
        numbers = {
            round(number, self.columns[column].digits)
            for number in (self.rows[index][column] for index in block)
            if isinstance(number, float)
        }
        if row not in block or len(numbers) < 2:
            return None
        order = sorted(numbers, reverse=better)
        place = order.index(round(value, self.columns[column].digits))
        return place if place < 2 else None


def without_empty_columns(table: Table) -> Table:
    """Return the table without the columns in which no row has anything."""
    kept = [
        index
        for index in range(len(table.columns))
        if any(cells[index] is not None for cells in table.rows)
    ]
    return replace(
        table,
        columns=tuple(table.columns[index] for index in kept),
        rows=tuple(tuple(cells[index] for index in kept) for cells in table.rows),
    )


def format_table(table: Table, format_name: str) -> str:
    """Return a table as text.

    Args:
        table: the table.
        format_name: one of `FORMATS`.
    """
    writers = {"md": to_markdown, "tex": to_latex, "csv": to_csv, "json": to_json}
    return writers[format_name](table)


def to_markdown(table: Table) -> str:
    """Return GitHub Markdown: best bold, second underlined, numbers to the right."""
    marks = {0: ("**", "**"), 1: ("<u>", "</u>"), None: ("", "")}

    def cell(row: int, column: int) -> str:
        before, after = marks[table.rank(row, column)]
        return before + _markdown_text(table.text(row, column)) + after

    heads = [_markdown_text((column.name + column.arrow).strip()) for column in table.columns]
    rules = [
        "---:" if any(isinstance(cells[index], int | float) for cells in table.rows) else "---"
        for index in range(len(table.columns))
    ]
    lines = [f"**{_markdown_text(table.caption)}**", "", _bar(heads), _bar(rules)]
    count = len(table.columns)
    lines += [_bar([cell(row, c) for c in range(count)]) for row in range(len(table.rows))]
    lines += [line for note in table.notes for line in ("", _markdown_text(note))]
    return "\n".join(lines) + "\n"


def _bar(cells: list[str]) -> str:
    return "| " + " | ".join(cells) + " |"


def _markdown_text(text: str) -> str:
    for char in "\\|*_`<>[]":
        text = text.replace(char, "\\" + char)
    return text.replace("\n", " ")


def to_latex(table: Table) -> str:
    """Return a booktabs table: best bold, second underlined."""
    marks = {0: r"\textbf{%s}", 1: r"\underline{%s}", None: "%s"}

    def cell(row: int, column: int) -> str:
        return marks[table.rank(row, column)] % _latex_text(table.text(row, column))

    count = len(table.columns)
    alignment = "".join(
        "r" if any(isinstance(cells[index], int | float) for cells in table.rows) else "l"
        for index in range(count)
    )
    lines = [
        r"\begin{table}[t]",
        r"  \centering",
        rf"  \caption{{{_latex_text(table.caption)}}}",
        rf"  \begin{{tabular}}{{{alignment}}}",
        r"    \toprule",
        *_latex_groups(table),
        "    " + " & ".join(_latex_text(c.heading) for c in table.columns) + r" \\",
        r"    \midrule",
    ]
    for row in range(len(table.rows)):
        lines += [r"    \midrule"] if row in table.breaks else []
        lines.append("    " + " & ".join(cell(row, column) for column in range(count)) + r" \\")
    lines += [r"    \bottomrule", r"  \end{tabular}"]
    lines += [rf"  \\ \footnotesize {_latex_text(note)}" for note in table.notes]
    return "\n".join([*lines, r"\end{table}"]) + "\n"


def _latex_groups(table: Table) -> list[str]:
    if not any(column.group for column in table.columns):
        return []
    spans: list[tuple[str, int]] = []
    for column in table.columns:
        if spans and spans[-1][0] == column.group:
            spans[-1] = (column.group, spans[-1][1] + 1)
        else:
            spans.append((column.group, 1))
    cells, rules, first = [], [], 1
    for group, width in spans:
        cells.append(rf"\multicolumn{{{width}}}{{c}}{{{_latex_text(group)}}}")
        if group:
            rules.append(rf"\cmidrule(lr){{{first}-{first + width - 1}}}")
        first += width
    return ["    " + " & ".join(cells) + r" \\", "    " + " ".join(rules)]


def _latex_text(text: str) -> str:
    escapes = {
        "\\": r"\textbackslash{}",
        "&": r"\&",
        "%": r"\%",
        "$": r"\$",
        "#": r"\#",
        "_": r"\_",
        "{": r"\{",
        "}": r"\}",
        "~": r"\textasciitilde{}",
        "^": r"\textasciicircum{}",
        "↑": r"$\uparrow$",
        "↓": r"$\downarrow$",
        "–": "--",
        "×": r"$\times$",
        "≤": r"$\leq$",
        "±": r"$\pm$",
        "✓": r"\checkmark",
        "\n": " ",
    }
    return "".join(escapes.get(char, char) for char in text)


def to_csv(table: Table) -> str:
    """Return CSV with full precision; an empty cell was not measured.

    A text that a spreadsheet would take for a formula begins with an apostrophe.
    """
    stream = io.StringIO()
    writer = csv.writer(stream, lineterminator="\n")
    writer.writerow([_csv_cell(column.name) for column in table.columns])
    writer.writerows([[_csv_cell(cell) for cell in row] for row in table.rows])
    return stream.getvalue()


def _csv_cell(cell: Cell) -> str | float | int:
    if cell is None:
        return ""
    formula = isinstance(cell, str) and cell.lstrip(" \t\n").startswith(("=", "+", "-", "@"))
    return f"'{cell}" if formula else cell


def to_json(table: Table) -> str:
    """Return JSON with full precision."""
    return json.dumps(to_object(table), indent=1, allow_nan=False) + "\n"


def to_object(table: Table) -> dict[str, Any]:
    """Return the JSON object of a table."""
    names = [column.name for column in table.columns]
    return {
        "caption": table.caption,
        "columns": [
            {"name": name, "higher_is_better": column.higher_is_better}
            for name, column in zip(names, table.columns, strict=True)
        ],
        "rows": [dict(zip(names, row, strict=True)) for row in table.rows],
        "notes": list(table.notes),
    }


def print_table(table: Table, width: int | None = None) -> None:
    """Print a table on standard output: styled on a terminal, plain text elsewhere.

    Where the encoding of standard output lacks rules and arrows, they are drawn in ASCII.

    Args:
        table: the table.
        width: in characters; None takes that of the terminal, `COLUMNS`, or 80.
    """
    import shutil

    from rich.console import Console
    from rich.text import Text

    class Output(Console):
        def on_broken_pipe(self) -> None:
            # Of rich's own it would be the end of the program, with status 1.
            raise

    width = width or shutil.get_terminal_size((WIDTH, 24)).columns
    console = Output(width=width)
    encoding = encoding_of(sys.stdout)
    for line in table_lines(table, width, marks=not console.is_terminal, encoding=encoding):
        whole = Text.assemble(*line.pieces)
        whole.rstrip()
        console.print(whole, no_wrap=True, overflow="ignore", crop=False)


def write_tables(folder: Path, tables: Mapping[str, Table]) -> None:
    """Write every table in every format: `overall.md`, `overall.tex`, ..."""
    for name, table in tables.items():
        for ending in FORMATS:
            atomic_write(folder / f"{name}.{ending}", format_table(table, ending))
