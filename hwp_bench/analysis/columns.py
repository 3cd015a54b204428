"""Tables that are declared by their columns: each column stands with its cells."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import replace
from typing import Any

from hwp_bench.base.tables import Cell, Column, Table
from hwp_bench.metrics import metric

#: A column, and its cell in each row.
Filled = tuple[Column, Sequence[Cell]]


def table_of(
    caption: str, columns: Iterable[Filled], notes: Iterable[str] = (), **options: Any
) -> Table:
    """Return the table of some columns, each with as many cells as there are rows."""
    heads, cells = zip(*columns, strict=True)
    rows = tuple(zip(*cells, strict=True))
    return Table(caption, heads, rows, tuple(notes), **options)


def with_columns(table: Table, columns: Iterable[Filled]) -> Table:
    """Return a table with further columns on its right."""
    more = table_of(table.caption, columns)
    rows = tuple((*row, *own) for row, own in zip(table.rows, more.rows, strict=True))
    return replace(table, columns=(*table.columns, *more.columns), rows=rows)


def score_title(name: str) -> str:
    """Return how tables call a metric: its label, with its unit where it has one."""
    facts = metric(name)
    return f"{facts.label} [{facts.unit}]" if facts.unit else facts.label


def score_column(name: str, group: str = "") -> Column:
    """Return the column of a metric: label and unit, digits, direction."""
    facts = metric(name)
    return Column(score_title(name), facts.digits, facts.higher_is_better, group)


def block_breaks(keys: Sequence[object]) -> tuple[int, ...]:
    """Return the rows at which a further block begins: those of another key than the row above."""
    return tuple(row for row in range(1, len(keys)) if keys[row] != keys[row - 1])
