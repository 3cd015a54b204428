"""The lines of a table on a terminal: numbers are never cut, columns that do not fit follow."""

from __future__ import annotations

import textwrap
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import groupby
from typing import Protocol

from hwp_bench.base.console import expressed

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


class Column(Protocol):
    """One column, as `hwp_bench.base.tables.Column`."""

    @property
    def heading(self) -> str:
        """The title with its arrow."""

    @property
    def higher_is_better(self) -> bool | None:
        """None for texts and counts."""

    @property
    def group(self) -> str:
        """Text over a group of columns."""


class Table(Protocol):
    """A table, as `hwp_bench.base.tables.Table`."""

    @property
    def caption(self) -> str:
        """Its caption."""

    @property
    def columns(self) -> Sequence[Column]:
        """Its columns."""

    @property
    def rows(self) -> Sequence[Sequence[str | float | int | None]]:
        """Its rows."""

    @property
    def notes(self) -> Sequence[str]:
        """Lines under the table."""

    @property
    def breaks(self) -> Sequence[int]:
        """Rows at which a further block begins."""

    def text(self, row: int, column: int) -> str:
        """Return a cell as it is printed."""

    def rank(self, row: int, column: int) -> int | None:
        """Return 0 for the best and 1 for the second best of a scored column, else None."""


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
