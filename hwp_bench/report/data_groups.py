"""Results by the data that they were made on: only those of one group are ranked together."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

from hwp_bench.base.files import sha256_json
from hwp_bench.base.tables import Cell, Column, Table
from hwp_bench.report.sources import ResultsSource
from hwp_bench.results import Results

#: Heading of the column that says which data a row is of.
HEADING = "Data"


@dataclass(frozen=True)
class DataGroup:
    """Results on the same captures, splits, test frames and masks, in the same protocols."""

    #: `A`, `B`, ... in the order of the results; empty where there is one group only.
    label: str
    #: What the group is of, in words.
    text: str
    #: The results.
    sources: tuple[ResultsSource, ...]


def data_groups(sources: Sequence[ResultsSource], *, oracles: bool = False) -> list[DataGroup]:
    """Return results by data, in the order of their first result.

    Args:
        sources: the results.
        oracles: keep runs on chosen training frames (`--frames clean`) with the others, for a
            table that shows both. Without it they are a group of their own.
    """
    found: dict[str, list[ResultsSource]] = {}
    for source in sources:
        found.setdefault(data_key(source.results, oracles=oracles), []).append(source)
    several = len(found) > 1
    return [
        DataGroup(_label(place) if several else "", _text(group[0].results), tuple(group))
        for place, group in enumerate(found.values())
    ]


def data_key(results: Results, *, oracles: bool = False) -> str:
    """Return a digest of the data of a result: captures, splits, test frames, masks, protocols.

    Args:
        results: the result.
        oracles: leave out which training frames the method was given.
    """
    captures = sorted(
        (c.id, c.digest, c.split_digest, [frame.frame for frame in c.frames], c.exact_masks)
        for c in results.captures
    )
    return sha256_json([captures, results.protocols, None if oracles else results.frames])


def _label(place: int) -> str:
    """Return `A` to `Z`, then `A1`, `B1`, ..."""
    return chr(ord("A") + place % 26) + (str(place // 26) if place >= 26 else "")


def _text(results: Results) -> str:
    frames = sum(len(capture.frames) for capture in results.captures)
    count = len(results.captures)
    headline = max((name for name in results.protocols if name.startswith("hwp-")), default="")
    protocol = sha256_json(results.protocols)[:8]
    parts = [
        f"{results.suite}, {count} capture{'' if count == 1 else 's'}, {frames} test frames",
        f"protocol {headline or 'not said'} ({protocol})",
    ]
    estimated = sum(not capture.exact_masks for capture in results.captures)
    if estimated:
        all_ = "" if estimated == count else f" in {estimated} captures"
        parts.append(f"scored on estimated masks{all_}")
    if results.frames != "perturbed":
        parts.append(f"{results.frames} training frames")
    return "; ".join(parts)


def stacked(groups: Sequence[DataGroup], tables: Sequence[Table]) -> Table:
    """Put the tables of several groups under one another; rows are ranked within their group.

    Args:
        groups: the groups.
        tables: the table of each, of one kind; their columns may differ.

    Returns:
        The only table, or one with a column that says which data a row is of. A column that a
        group lacks is empty in its rows.
    """
    if len(tables) == 1:
        return tables[0]
    columns = _joined([table.columns for table in tables])
    rows: list[tuple[Cell, ...]] = []
    breaks, unranked = [], set()
    for group, table in zip(groups, tables, strict=True):
        start = len(rows)
        breaks += [start, *(start + place for place in table.breaks)]
        unranked |= {start + place for place in table.unranked}
        # A table that ranks nothing keeps its rows out of the ranks.
        unranked |= set() if table.ranked else set(range(start, start + len(table.rows)))
        places = [_place(table.columns, column) for column in columns]
        rows += [
            (group.label, *(None if place is None else row[place] for place in places))
            for row in table.rows
        ]
    notes = ["Results are on different data: only rows of the same data are ranked together."]
    notes += [f"{HEADING} {group.label}: {group.text}." for group in groups]
    notes += _importer_notes(groups)
    seen = [
        (group.label, note)
        for group, table in zip(groups, tables, strict=True)
        for note in table.notes
    ]
    for note in dict.fromkeys(note for _, note in seen):
        owners = [label for label, text in seen if text == note]
        said_by_all = len(owners) == len(groups)
        notes.append(note if said_by_all else f"{', '.join(owners)}: {note}")
    return Table(
        tables[0].caption,
        (Column(HEADING), *columns),
        tuple(rows),
        tuple(notes),
        breaks=tuple(breaks[1:]),
        unranked=frozenset(unranked),
    )


def _importer_notes(groups: Sequence[DataGroup]) -> list[str]:
    """Return a warning for captures of one name that different importers made."""
    makers: dict[str, dict[str, None]] = {}
    for group in groups:
        for source in group.sources:
            for capture in source.results.captures:
                made_by = capture.made_by or "not stated"
                makers.setdefault(capture.id, {})[made_by] = None
    return [
        f"{name} was made by different importers ({', '.join(found)}): its scores do not compare."
        for name, found in makers.items()
        if len(found) > 1
    ]


def _joined(every: Sequence[Sequence[Column]]) -> list[Column]:
    """Return the columns of several tables, those of a group next to each other."""
    found: list[Column] = []
    for columns in every:
        for column in columns:
            if _place(found, column) is not None:
                continue
            kin = [i for i, c in enumerate(found) if column.group and c.group == column.group]
            found.insert(kin[-1] + 1 if kin else len(found), replace(column))
    return found


def _place(columns: Sequence[Column], wanted: Column) -> int | None:
    """Return where the column of that group and title is."""
    for place, column in enumerate(columns):
        if (column.group, column.title) == (wanted.group, wanted.title):
            return place
    return None
