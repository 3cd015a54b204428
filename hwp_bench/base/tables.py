"""A table and its formats: Markdown, LaTeX, CSV, JSON, terminal."""

from __future__ import annotations

import csv
import io
import json
import shutil
import sys
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from itertools import groupby, product
from pathlib import Path
from typing import Any

from hwp_bench.base.console import encoding_of, expressed, on_terminal
from hwp_bench.base.files import atomic_write

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

    def counts(self, column: int) -> bool:
        """Whether a column holds numbers, which stand to the right."""
        return any(isinstance(cells[column], int | float) for cells in self.rows)

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
    every = range(len(table.columns))
    kept = [index for index in every if any(cells[index] is not None for cells in table.rows)]
    return replace(
        table,
        columns=tuple(table.columns[index] for index in kept),
        rows=tuple(tuple(cells[index] for index in kept) for cells in table.rows),
    )


def format_table(table: Table, format_name: str) -> str:
    """Return a table as text."""
    writers = {"md": to_markdown, "tex": to_latex, "csv": to_csv, "json": to_json}
    return writers[format_name](table)


def to_markdown(table: Table) -> str:
    """Return GitHub Markdown: best bold, second underlined, numbers to the right."""
    marks = {0: ("**", "**"), 1: ("<u>", "</u>"), None: ("", "")}

    def cell(row: int, column: int) -> str:
        before, after = marks[table.rank(row, column)]
        return before + _markdown_text(table.text(row, column)) + after

    heads = [_markdown_text((column.name + column.arrow).strip()) for column in table.columns]
    count = len(table.columns)
    rules = ["---:" if table.counts(index) else "---" for index in range(count)]
    lines = [f"**{_markdown_text(table.caption)}**", "", _bar(heads), _bar(rules)]
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
    """Return a booktabs table: best bold, second underlined; check marks need amssymb."""
    marks = {0: r"\textbf{%s}", 1: r"\underline{%s}", None: "%s"}

    def cell(row: int, column: int) -> str:
        return marks[table.rank(row, column)] % _latex_text(table.text(row, column))

    count = len(table.columns)
    alignment = "".join("r" if table.counts(index) else "l" for index in range(count))
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
    cells, rules, first = [], [], 1
    for group, members in groupby(table.columns, key=lambda column: column.group):
        width = len(list(members))
        cells.append(rf"\multicolumn{{{width}}}{{c}}{{{_latex_text(group)}}}")
        if group:
            rules.append(rf"\cmidrule(lr){{{first}-{first + width - 1}}}")
        first += width
    return ["    " + " & ".join(cells) + r" \\", "    " + " ".join(rules)]


def _latex_text(text: str) -> str:
    escapes = {char: f"\\{char}" for char in "&%$#_{}"} | {
        "\\": r"\textbackslash{}",
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


def write_tables(folder: Path, tables: Mapping[str, Table]) -> None:
    """Write every table in every format: `overall.md`, `overall.tex`, ..."""
    for name, table in tables.items():
        for ending in FORMATS:
            atomic_write(folder / f"{name}.{ending}", format_table(table, ending))


def print_table(table: Table, width: int | None = None) -> None:
    """Print a table on standard output: styled on a terminal, plain text elsewhere.

    Where the encoding of standard output lacks rules and arrows, they are drawn in ASCII.
    """
    width = width or shutil.get_terminal_size((_WIDTH, 24)).columns
    styled = on_terminal(sys.stdout)
    print(draw_table(table, width, styled=styled, encoding=encoding_of(sys.stdout)), end="")


def draw_table(table: Table, width: int, *, styled: bool = False, encoding: str = "utf-8") -> str:
    """Return a table as it stands on a terminal.

    The columns that name a row stand in front of every block of the others. Columns of one group
    stay together where they fit. Texts are folded; numbers never are.
    """
    from rich.console import Console

    drawing = _Drawing(table, width, "" if styled else _BEST, encoding)
    widest = max(_total(drawing.widths, columns) for columns in drawing.blocks())
    console = Console(
        width=max(width, widest), force_terminal=styled, highlight=False, file=io.StringIO()
    )
    with console.capture() as drawn:
        for part in drawing.parts():
            console.print(part)
    return "".join(f"{line.rstrip()}\n" for line in drawn.get().splitlines())


#: Columns where no terminal says how wide it is.
_WIDTH = 80
#: Spaces between two columns.
_GAP = 2
#: Narrowest that a column of text is folded to, and widest that one keeps if others lack space.
_FOLDED = (12, 24)
#: Marks the best value where nothing can be bold.
_BEST = "*"
_STYLES = {0: "bold", 1: "underline", None: ""}


def _total(widths: Sequence[int], columns: Sequence[int]) -> int:
    """The width of some columns side by side."""
    return sum(widths[index] for index in columns) + _GAP * (len(columns) - 1)


class _Drawing:
    """A table in characters that an encoding has, cut into blocks that fit a width."""

    def __init__(self, table: Table, width: int, mark: str, encoding: str) -> None:
        self.fit = partial(expressed, encoding=encoding)
        self.table = table
        self.width = width
        self.mark = mark
        #: Of all cells, as they are printed.
        self.cells = [
            [self._cell(row, column) for column in range(len(table.columns))]
            for row in range(len(table.rows))
        ]
        self.headings = [self.fit(column.heading) for column in table.columns]
        self.numbers = [table.counts(index) for index in range(len(table.columns))]
        #: How many columns name a row: all before the first with a measurement.
        self.keys = 1
        for index, column in enumerate(table.columns):
            measured = any(isinstance(cells[index], float) for cells in table.rows)
            if measured or column.higher_is_better is not None or column.group:
                self.keys = max(index, 1)
                break
        self.widths = self._widths()

    def parts(self) -> Iterator[Any]:
        """What `rich` prints: the caption, the blocks, and the notes under them."""
        from rich.text import Text

        if self.table.caption:
            yield Text(self.fit(self.table.caption), "italic")
        for number, columns in enumerate(self.blocks()):
            yield from [""] if number else []
            yield from self._block(columns)
        notes = [self.fit(note) for note in self.table.notes]
        ranked = any(column.higher_is_better is not None for column in self.table.columns)
        if ranked and self.fit("↑") != "↑":
            notes.append(f"{self.fit('↑')} higher is better, {self.fit('↓')} lower is better.")
        everything = product(range(len(self.cells)), range(len(self.headings)))
        if self.mark and any(self.table.rank(*place) == 0 for place in everything):
            notes.append(f"{self.mark} the best of the rows on the same data.")
        yield from (Text(note, "dim") for note in notes)

    def blocks(self) -> list[list[int]]:
        """The columns of each block: those that name the rows, and as many others as fit."""
        names = list(range(self.keys))
        rest = range(self.keys, len(self.table.columns))
        found: list[list[int]] = [names]
        for _, unit in groupby(rest, key=lambda i: self.table.columns[i].group or i):
            together = list(unit)
            fits = _total(self.widths, [*names, *together]) <= self.width
            for piece in [together] if fits else [[index] for index in together]:
                if found[-1] != names and _total(self.widths, [*found[-1], *piece]) > self.width:
                    found.append(names)
                found[-1] = [*found[-1], *piece]
        return found

    def _cell(self, row: int, column: int) -> str:
        text = self.fit(self.table.text(row, column))
        if not self.mark or self.table.columns[column].higher_is_better is None:
            return text
        return text + (self.mark if self.table.rank(row, column) == 0 else " ")

    def _widths(self) -> list[int]:
        """The width of each column; texts are folded where not all fit, numbers never."""
        least, most = _FOLDED
        natural = [
            max([1, *map(len, heading.split()), *(len(cells[index]) for cells in self.cells)])
            for index, heading in enumerate(self.headings)
        ]
        self.widths = natural
        everything = range(len(natural))
        # The last column of a group makes room for the longest word of its name.
        for group, run in groupby(everything, key=lambda i: self.table.columns[i].group):
            members = list(run)
            lacks = max(map(len, group.split()), default=0) - _total(natural, members)
            natural[members[-1]] += max(lacks, 0)
        # Those that name rows are folded until all fits, or until they leave half to numbers.
        for limit in range(most, least - 1, -1):
            if _total(self.widths, everything) <= self.width:
                return self.widths
            self.widths = [
                min(width, limit) if index < self.keys and not self.numbers[index] else width
                for index, width in enumerate(natural)
            ]
            if _total(self.widths, everything[: self.keys]) <= self.width // 2:
                break
        # A name that fits a line stays whole, so that it can be copied; prose is folded.
        room = max(self.width - _total(self.widths, everything[: self.keys]) - _GAP, most)
        for index in everything[self.keys :]:
            if not self.numbers[index] and natural[index] > min(room, 2 * most):
                self.widths[index] = min(room, max(most, self.width // 2))
        return self.widths

    def _block(self, columns: Sequence[int]) -> Iterator[Any]:
        """The line that names groups of columns, if there are any; heading, rule and rows."""
        from rich.box import Box
        from rich.table import Table as RichTable
        from rich.text import Text

        rule = self.fit("─")
        if any(self.table.columns[index].group for index in columns):
            yield self._groups(columns, rule)
        lines = ["    "] * 8
        lines[2] = lines[4] = rule * 4
        box = Box("\n".join(lines), ascii=True)
        space = (0, _GAP - 1, 0, 0)
        grid = RichTable(
            box=box, show_edge=False, pad_edge=False, padding=space, header_style="bold"
        )
        for index in columns:
            heading = Text(self.headings[index], justify="right" if self.numbers[index] else "left")
            grid.add_column(heading, width=self.widths[index], overflow="fold")
        for row, cells in enumerate(self._rows(columns)):
            if row in self.table.breaks:
                grid.add_section()
            ranks = [self.table.rank(row, index) for index in columns]
            grid.add_row(*(Text(c, _STYLES[r]) for c, r in zip(cells, ranks, strict=True)))
        yield grid

    def _groups(self, columns: Sequence[int], rule: str) -> Any:
        """The names of groups over a block, centred in a rule where there is room for one."""
        from rich.rule import Rule
        from rich.table import Table as RichTable
        from rich.text import Text

        line = RichTable.grid(padding=(0, _GAP, 0, 0))
        cells: list[Any] = []
        for group, run in groupby(columns, key=lambda i: self.table.columns[i].group):
            name, span = self.fit(group), _total(self.widths, list(run))
            line.add_column(width=span, justify="center", vertical="bottom")
            ruled = name and len(name) + 4 <= span
            cells.append(Rule(name, characters=rule, style="bold") if ruled else Text(name, "bold"))
        line.add_row(*cells)
        return line

    def _rows(self, columns: Sequence[int]) -> list[list[str]]:
        """The cells of each row, numbers to the right.

        Where blocks of rows begin with the same texts, these stand in the first row alone. The last
        column that names rows is always printed.
        """
        found = [
            [c[i].rjust(self.widths[i]) if self.numbers[i] else c[i] for i in columns]
            for c in self.cells
        ]
        named = self.keys - 1 if self.table.breaks else 0
        for row in range(len(found) - 1, 0, -1):
            above, own = self.cells[row - 1], self.cells[row]
            for place in range(0 if row in self.table.breaks else named):
                if own[: place + 1] == above[: place + 1]:
                    found[row][place] = ""
        return found
