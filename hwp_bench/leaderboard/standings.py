"""The leaderboard on the terminal: a table for each suite and protocol, ranked with intervals."""

from __future__ import annotations

from collections.abc import Sequence

from hwp_bench.analysis.statistics.pairing import MethodRuns, group_runs
from hwp_bench.analysis.statistics.ranks import Rank, rank_methods, verdict
from hwp_bench.base.errors import UsageError
from hwp_bench.base.tables import Cell, Column, Table
from hwp_bench.leaderboard.entries import Entry
from hwp_bench.leaderboard.rules import HEADLINE, current, missing, tables_of
from hwp_bench.metrics import HWP_V1
from hwp_bench.report.evaluation_tables import labels, score_column
from hwp_bench.report.ranking_tables import METRIC


def board_tables(entries: Sequence[Entry]) -> list[Table]:
    """Return a table for each suite and protocol, best row first.

    Rows that another one revises are left out. A row that lacks a part of its suite is shown
    without a rank. Entries that differ only in the seed are ranked together and have a row each.

    Args:
        entries: entries that `rules.check_entries` has passed.
    """
    found = tables_of(current(entries))
    return [_table(suite, protocol, rows) for (suite, protocol), rows in found.items()]


def _table(suite: str, protocol: str, entries: Sequence[Entry]) -> Table:
    whole = [entry for entry in entries if not missing(entry.results)]
    ranks, sentence = _ranks(whole)
    titles = dict(
        zip(
            (entry.name for entry in entries),
            labels([entry.results for entry in entries]),
            strict=True,
        )
    )
    order = sorted(
        entries,
        key=lambda entry: (
            entry not in whole,
            ranks[entry.name].rank if entry.name in ranks else len(entries),
            -entry.results.scores[METRIC],
            entry.name,
        ),
    )
    columns = (
        Column("Method"),
        Column("Rank", 0, group="Rank"),
        Column("95 %", group="Rank"),
        *(score_column(name) for name in HEADLINE),
        Column("Fit [s]", 1),
        Column("Level"),
        Column("Badge"),
        Column("Entry"),
    )
    rows: list[tuple[Cell, ...]] = []
    for entry in order:
        rank = ranks.get(entry.name)
        fits = [c.fit_seconds for c in entry.results.captures if c.fit_seconds is not None]
        rows.append(
            (
                titles[entry.name],
                rank.rank if rank else None,
                _interval(rank) if rank else None,
                *(entry.results.scores[name] for name in HEADLINE),
                sum(fits) / len(fits) if fits else None,
                entry.level,
                entry.badge,
                entry.name,
            )
        )
    notes = [sentence] if sentence else []
    lacking = frozenset(place for place, entry in enumerate(order) if entry not in whole)
    if lacking:
        notes.append("Rows that lack captures or test frames of the suite have no rank.")
    if protocol != HWP_V1.name:
        notes.append(f"Scored by {protocol}; rows of {HWP_V1.name} stand in another table.")
    return Table(
        f"Suite {suite}, protocol {protocol}",
        columns,
        tuple(rows),
        tuple(notes),
        unranked=lacking,
    )


def _interval(rank: Rank) -> str:
    return f"{rank.best}" if rank.best == rank.worst else f"{rank.best} to {rank.worst}"


def _ranks(entries: Sequence[Entry]) -> tuple[dict[str, Rank], str]:
    """Return the rank of each entry by its name, and the sentence that says who wins."""
    if not entries:
        return {}, ""
    try:
        runs = group_runs([entry.results for entry in entries])
        ranking = rank_methods(runs, METRIC)
    except UsageError as error:
        # Such as one run that was submitted twice, or methods without a seed in common.
        return {}, f"No ranks: {error.problem}."
    by_label = {item.standing.label: item for item in ranking.ranks}
    names = {
        entry.name: by_label[run.label] for entry in entries for run in runs if _has(run, entry)
    }
    return names, verdict(ranking)


def _has(run: MethodRuns, entry: Entry) -> bool:
    return any(results is entry.results for results in run.seeds.values())
