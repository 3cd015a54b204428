"""The leaderboard on the terminal: a table for each suite and protocol, ranked with intervals."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

from hwp_bench.analysis.statistics.pairing import group_runs
from hwp_bench.analysis.statistics.ranks import Rank, rank_methods, verdict
from hwp_bench.base.tables import Cell, Column, Table
from hwp_bench.leaderboard.board_rows import MethodRow, method_rows
from hwp_bench.leaderboard.entries import Entry
from hwp_bench.leaderboard.rankable import rankable
from hwp_bench.leaderboard.rules import HEADLINE, tables_of
from hwp_bench.metrics import HWP_V1
from hwp_bench.report.evaluation_tables import score_column
from hwp_bench.report.ranking_tables import METRIC
from hwp_bench.results import Results


def board_tables(entries: Sequence[Entry]) -> list[Table]:
    """Return a table for each suite and protocol, best row first.

    Each method has one row, of its newest entries that were checked furthest; its older ones are
    left out. A row that lacks a part of its suite is shown without a rank.

    Args:
        entries: entries that `rules.check_entries` has passed.
    """
    found = tables_of(entries)
    return [_table(suite, protocol, rows) for (suite, protocol), rows in found.items()]


def _table(suite: str, protocol: str, entries: Sequence[Entry]) -> Table:
    methods = method_rows(entries)
    rows = [method.row for method in methods]
    ranks, sentence = ranks_of(methods)
    titles = {method.row.entries[0].name: method.label for method in methods}
    order = sorted(
        rows,
        key=lambda row: (
            not row.whole,
            ranks[row.entries[0].name].rank if row.entries[0].name in ranks else len(rows),
            -row.scores[METRIC],
            row.entries[0].name,
        ),
    )
    columns = (
        Column("Method"),
        Column("Rank", 0, group="Rank"),
        Column("95 %", group="Rank"),
        *(score_column(name) for name in HEADLINE),
        Column("Fit [s]", 1),
        Column("Seeds", 0),
        Column("Level"),
        Column("Badge"),
        Column("Entry"),
    )
    cells: list[tuple[Cell, ...]] = []
    for row in order:
        first = row.entries[0].name
        rank = ranks.get(first)
        cells.append(
            (
                titles[first],
                rank.rank if rank else None,
                rank_interval(rank) if rank else None,
                *(row.scores[name] for name in HEADLINE),
                row.fit_seconds,
                len(row.seeds),
                row.level,
                row.badge,
                first if len(row.seeds) == 1 else f"{first} and {len(row.seeds) - 1} more",
            )
        )
    notes = [sentence] if sentence else []
    lacking = frozenset(place for place, row in enumerate(order) if not row.whole)
    if lacking:
        notes.append("Rows that lack captures or test frames of the suite have no rank.")
    if protocol != HWP_V1.name:
        notes.append(f"Scored by {protocol}; rows of {HWP_V1.name} stand in another table.")
    if older := sum(len(method.older) for method in methods):
        notes.append(f"{older} older or less checked entries of these methods are not shown.")
    return Table(
        f"Suite {suite}, protocol {protocol}",
        columns,
        tuple(cells),
        tuple(notes),
        unranked=lacking,
    )


def _called(results: Results, label: str) -> Results:
    return replace(results, method=replace(results.method, title=label))


def rank_interval(rank: Rank) -> str:
    """Return the ranks that the data allow in words: `1`, or `1 to 3`."""
    return f"{rank.best}" if rank.best == rank.worst else f"{rank.best} to {rank.worst}"


def ranks_of(methods: Sequence[MethodRow]) -> tuple[dict[str, Rank], str]:
    """Return ranks by the name of a row's first entry, and the sentence that says who wins.

    Args:
        methods: of one suite and one version of the protocol. Those that `rankable` leaves out get
            no rank, and the sentence names them.
    """
    ranked, left_out = rankable([method.row for method in methods])
    if not ranked:
        return {}, ""
    labels = {method.row.entries[0].name: method.label for method in methods}
    compared = {
        row.entries[0].name: [_called(one, labels[row.entries[0].name]) for one in row.compared]
        for row in ranked
    }
    runs = group_runs([one for results in compared.values() for one in results])
    ranking = rank_methods(runs, METRIC)
    by_label = {item.standing.label: item for item in ranking.ranks}
    found = {
        name: by_label[run.label]
        for name, (first, *_) in compared.items()
        for run in runs
        if any(first is results for results in run.seeds.values())
    }
    return found, f"{verdict(ranking)} {left_out}".rstrip()
