"""Tables in which evaluations that differ in nothing but the seed are one row of means."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

from hwp_bench.analysis.statistics.pairing import group_runs
from hwp_bench.base.errors import UsageError
from hwp_bench.base.tables import Cell, Table
from hwp_bench.report.evaluation_tables import labels
from hwp_bench.results import Results

_NOTE = "Means over seeds, where a method has several; `--by seeds` shows how they spread."
#: Heading of the column that names evaluations.
_METHOD = "Method"


def over_seeds(table: Table, results: Sequence[Results]) -> Table:
    """Merge the rows of a table that differ in nothing but the seed.

    Measurements become means. Counts to the right of the method's name are added up, and texts
    there are joined.

    Args:
        table: with one row, or one in each block, for each of the results, which its column
            `Method` calls by `labels(results)`.
        results: the evaluations.

    Returns:
        The table; as it is where no method has several seeds, or one has a seed twice.
    """
    try:
        runs = group_runs(results)
    except UsageError:
        return table
    if len(runs) == len(results):
        return table
    names = dict(zip(map(id, results), labels(results), strict=True))
    titles = {
        names[id(result)]: title
        for run, title in zip(runs, labels([run.first for run in runs]), strict=True)
        for result in run.seeds.values()
    }
    place = [column.title for column in table.columns].index(_METHOD)
    edges = {*table.breaks, 0}
    block = 0
    merged: dict[tuple[object, ...], list[int]] = {}
    for number, row in enumerate(table.rows):
        block += number in edges
        named = (block, *row[:place], titles[str(row[place])])
        merged.setdefault(named, []).append(number)
    rows: list[tuple[Cell, ...]] = []
    breaks: list[int] = []
    for key, members in merged.items():
        if members[0] in table.breaks:
            breaks.append(len(rows))
        tails = [table.rows[number][place + 1 :] for number in members]
        means = [_merged(values) for values in zip(*tails, strict=True)]
        rows.append((*table.rows[members[0]][:place], str(key[-1]), *means))
    unranked = frozenset(
        index for index, members in enumerate(merged.values()) if table.unranked.issuperset(members)
    )
    return replace(
        table,
        rows=tuple(rows),
        breaks=tuple(breaks),
        unranked=unranked,
        notes=(*table.notes, _NOTE),
    )


def _merged(values: Sequence[Cell]) -> Cell:
    """Mean of measurements, sum of counts, texts joined; None where one of them is missing."""
    if any(value is None for value in values):
        return None
    numbers = [value for value in values if isinstance(value, int | float)]
    if len(numbers) < len(values):
        return ", ".join(dict.fromkeys(str(value) for value in values))
    if all(isinstance(value, int) for value in numbers):
        return sum(numbers)
    return sum(numbers) / len(numbers)
