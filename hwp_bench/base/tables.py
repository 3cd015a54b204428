"""A table and its formats: Markdown, LaTeX, CSV, JSON, terminal."""

from __future__ import annotations

import csv
import io
import json
import sys
import textwrap
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import groupby
from pathlib import Path
from typing import Any

from hwp_bench.base.console import encoding_of, expressed
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


#: Columns where no terminal says how wide it is.
WIDTH = 80
#: Spaces between two columns.
_GAP = 2
#: Narrowest that a column of text is folded to, and widest that one keeps if others lack space.
_FOLDED = (12, 24)
#: Marks the best value where nothing can be bold.
_BEST = "*"
#: Under a table with such a mark.
_LEGEND = f"{_BEST} the best of the rows on the same data."
#: What rules are drawn with.
_RULE = "─"


@dataclass(frozen=True)
class Line:
    """One printed line: pieces of text with their styles."""

    #: (text, style of `rich`, empty for plain).
    pieces: tuple[tuple[str, str], ...]

    @property
    def text(self) -> str:
        """The line without styles."""
        return "".join(piece for piece, _ in self.pieces).rstrip()


@dataclass(frozen=True)
class _FittedColumn:
    """A column in characters that an encoding has."""

    heading: str
    higher_is_better: bool | None
    group: str


@dataclass(frozen=True)
class _FittedTable:
    """A table in characters that an encoding has."""

    table: Table
    encoding: str
    columns: Sequence[_FittedColumn]

    @property
    def caption(self) -> str:
        return self.fit(self.table.caption)

    @property
    def rows(self) -> Sequence[Sequence[str | float | int | None]]:
        return self.table.rows

    @property
    def notes(self) -> Sequence[str]:
        notes = [self.fit(note) for note in self.table.notes]
        if any(column.higher_is_better is not None for column in self.columns):
            up, down = self.fit("↑"), self.fit("↓")
            notes += [f"{up} higher is better, {down} lower is better."] if up != "↑" else []
        return notes

    @property
    def breaks(self) -> Sequence[int]:
        return self.table.breaks

    def text(self, row: int, column: int) -> str:
        return self.fit(self.table.text(row, column))

    def rank(self, row: int, column: int) -> int | None:
        return self.table.rank(row, column)

    def fit(self, text: str) -> str:
        return expressed(text, self.encoding)


def _fitted(table: Table, encoding: str) -> _FittedTable:
    columns = [
        _FittedColumn(
            expressed(column.heading, encoding),
            column.higher_is_better,
            expressed(column.group, encoding),
        )
        for column in table.columns
    ]
    return _FittedTable(table, encoding, columns)


def table_lines(
    table: Table, width: int, *, marks: bool = False, encoding: str = "utf-8"
) -> list[Line]:
    """Return the lines of a table.

    The columns that name a row stand in front of every block of the others. Columns of one group
    stay together where they fit. Texts are folded; numbers never are.

    Args:
        table: the table.
        width: in characters; a table whose narrowest form is wider is printed wider.
        marks: mark best values with a character.
        encoding: of what the lines are printed on; what it lacks is said in ASCII.
    """
    table = _fitted(table, encoding)
    lines = _folded(table.caption, width, "italic")
    keys = _keys(table)
    widths = [_natural(table, index, marks) for index in range(len(table.columns))]
    if _total(widths) > width:
        widths = _narrowed(table, widths, keys, width)
    rule = table.fit(_RULE)
    for number, block in enumerate(_blocks(table, widths, keys, width)):
        lines += [Line((("", ""),))] if number else []
        columns = [*range(keys), *block]
        spread = _spread(table, columns, widths, width)
        lines += _block_lines(table, columns, spread, marks, rule)
    notes = list(table.notes)
    if marks and any(
        table.rank(row, column) == 0
        for row in range(len(table.rows))
        for column in range(len(table.columns))
    ):
        notes.append(_LEGEND)
    return lines + [line for note in notes for line in _folded(note, width, "dim")]


def _folded(text: str, width: int, style: str) -> list[Line]:
    return [Line(((part, style),)) for part in _wrapped(text, width)]


def _wrapped(text: str, width: int) -> list[str]:
    return textwrap.wrap(text, width, break_on_hyphens=False) or [""]


def _is_number(table: Table, column: int) -> bool:
    return any(isinstance(cells[column], int | float) for cells in table.rows)


def _keys(table: Table) -> int:
    """Return the number of columns that name a row: all before the first with a measurement."""
    for index, column in enumerate(table.columns):
        measured = any(isinstance(cells[index], float) for cells in table.rows)
        if measured or column.higher_is_better is not None or column.group:
            return max(index, 1)
    return 1


def _cell(table: Table, row: int, column: int, marks: bool) -> str:
    text = table.text(row, column)
    if not marks or table.columns[column].higher_is_better is None:
        return text
    return text + (_BEST if table.rank(row, column) == 0 else " ")


def _natural(table: Table, column: int, marks: bool) -> int:
    """Return the width of a column that folds its heading only."""
    words = table.columns[column].heading.split()
    cells = [len(_cell(table, row, column, marks)) for row in range(len(table.rows))]
    return max([1, *map(len, words), *cells])


def _total(widths: Sequence[int]) -> int:
    return sum(widths) + _GAP * (len(widths) - 1)


def _narrowed(table: Table, widths: Sequence[int], keys: int, width: int) -> list[int]:
    """Return widths with texts folded.

    Those that name rows are folded until all fits, or until they leave half of the line to numbers.
    """
    least, most = _FOLDED
    found = list(widths)
    for index in range(keys):
        if not _is_number(table, index):
            found[index] = min(found[index], most)
    while _total(found[:keys]) > max(width // 2, least) and _total(found) > width:
        wide = [i for i in range(keys) if not _is_number(table, i) and found[i] > least]
        if not wide:
            break
        found[max(wide, key=lambda i: found[i])] -= 1
    room = max(width - _total(found[:keys]) - _GAP, most)
    for index in range(keys, len(found)):
        # A name that fits a line stays whole, so that it can be copied; prose is folded.
        if not _is_number(table, index) and found[index] > min(room, 2 * most):
            found[index] = min(room, max(most, width // 2))
    return found


def _blocks(table: Table, widths: Sequence[int], keys: int, width: int) -> list[list[int]]:
    """Return the columns of each block, without those that name the rows."""
    room = width - _total(widths[:keys]) - _GAP if keys else width
    rest = range(keys, len(table.columns))
    units = [
        list(unit) for _, unit in groupby(rest, key=lambda i: (table.columns[i].group or f"\0{i}",))
    ]
    blocks: list[list[int]] = [[]]
    for unit in units:
        whole = [widths[i] for i in unit]
        pieces = [unit] if _total(whole) <= room else [[i] for i in unit]
        for piece in pieces:
            taken = [widths[i] for i in [*blocks[-1], *piece]]
            if blocks[-1] and _total(taken) > room:
                blocks.append([])
            blocks[-1] += piece
    return blocks


def _spread(
    table: Table, columns: Sequence[int], widths: Sequence[int], width: int
) -> Sequence[int]:
    """Widen the last column of each group whose name has a longer word, where there is room."""
    found = list(widths)
    for group, run in groupby(columns, key=lambda i: table.columns[i].group):
        members = list(run)
        word = max((len(part) for part in group.split()), default=0)
        lacks = word - _total([found[i] for i in members])
        if 0 < lacks <= width - _total([found[i] for i in columns]):
            found[members[-1]] += lacks
    return found


def _block_lines(
    table: Table, columns: Sequence[int], widths: Sequence[int], marks: bool, stroke: str
) -> list[Line]:
    """Return heading, rule (of strokes) and rows of one block."""
    rule = Line(((stroke * _total([widths[i] for i in columns]), "dim"),))
    lines = _group_line(table, columns, widths, stroke)
    heads = [_wrapped(table.columns[i].heading, widths[i]) for i in columns]
    deepest = max(map(len, heads))
    heads = [[""] * (deepest - len(head)) + head for head in heads]
    for depth in range(deepest):
        lines.append(_joined(table, columns, widths, [head[depth] for head in heads], "bold"))
    lines.append(rule)
    styles = {0: "bold", 1: "underline", None: ""}
    cells = _row_parts(table, columns, widths, marks)
    for row, parts in enumerate(cells):
        lines += [rule] if row in table.breaks else []
        ranks = [styles[table.rank(row, i)] for i in columns]
        for depth in range(max(map(len, parts))):
            pieces = [part[depth] if depth < len(part) else "" for part in parts]
            lines.append(_joined(table, columns, widths, pieces, ranks))
    return lines


def _row_parts(
    table: Table, columns: Sequence[int], widths: Sequence[int], marks: bool
) -> list[list[list[str]]]:
    """Return the folded lines of each cell of each row.

    Where blocks of rows begin with the same texts, a text stands once and flows down over the rows
    that repeat it. The last column that names rows is always printed.
    """
    found = [
        [_parts(_cell(table, row, i, marks), widths[i]) for i in columns]
        for row in range(len(table.rows))
    ]
    if not table.breaks:
        return found
    named = sum(1 for i in columns if i < _keys(table)) - 1
    for place in range(named):
        for run in _repeats(table, columns[: place + 1]):
            left = found[run[0]][place]
            for row in run:
                own = max(len(part) for part in found[row][place + 1 :])
                room = len(left) if row == run[-1] else own
                found[row][place], left = left[:room], left[room:]
    return found


def _repeats(table: Table, columns: Sequence[int]) -> list[list[int]]:
    """Return the runs of rows of one block that have the same texts in some columns."""
    runs: list[list[int]] = []
    for row in range(len(table.rows)):
        texts = [table.text(row, i) for i in columns]
        again = runs and row not in table.breaks
        if again and texts == [table.text(runs[-1][0], i) for i in columns]:
            runs[-1].append(row)
        else:
            runs.append([row])
    return runs


def _parts(text: str, width: int) -> list[str]:
    """Return a cell's lines; spaces at its end stay, which keep numbers in line."""
    if len(text) <= width:
        return [text]
    return _wrapped(text, width)


def _joined(
    table: Table,
    columns: Sequence[int],
    widths: Sequence[int],
    texts: Sequence[str],
    styles: str | Sequence[str],
) -> Line:
    each = [styles] * len(columns) if isinstance(styles, str) else styles
    pieces: list[tuple[str, str]] = []
    for place, (index, text, style) in enumerate(zip(columns, texts, each, strict=True)):
        space = " " * (widths[index] - len(text))
        gap = " " * (_GAP if place else 0)
        if _is_number(table, index):
            pieces += [(gap + space, ""), (text, style)]
        else:
            pieces += [(gap, ""), (text, style), (space, "")]
    return Line(tuple(pieces))


def _group_line(
    table: Table, columns: Sequence[int], widths: Sequence[int], stroke: str
) -> list[Line]:
    """Return the line over the heading that names groups of columns, if there are any."""
    if not any(table.columns[i].group for i in columns):
        return []
    depths: list[tuple[int, list[str], bool]] = []
    for group, members in groupby(columns, key=lambda i: table.columns[i].group):
        span = _total([widths[i] for i in members])
        depths.append((span, _wrapped(group, span), bool(group)))
    deepest = max(len(texts) for _, texts, _ in depths)
    lines = []
    for depth in range(deepest):
        parts = []
        for span, texts, named in depths:
            padded = [""] * (deepest - len(texts)) + texts
            text = padded[depth]
            last = named and depth == deepest - 1 and len(text) + 4 <= span
            parts.append(f" {text} ".center(span, stroke) if last else text.center(span))
        lines.append(Line((((" " * _GAP).join(parts), "bold"),)))
    return lines
