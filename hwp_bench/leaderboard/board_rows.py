"""Rows of the board: one for each method and suite, over its seeds; what was before is history."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass

from hwp_bench.analysis.statistics.pairing import same_but_seed
from hwp_bench.evaluation.sentences import find_missing
from hwp_bench.leaderboard.entries import Entry
from hwp_bench.leaderboard.records import BADGES, LEVELS
from hwp_bench.leaderboard.rules import current, source_of
from hwp_bench.leaderboard.suite_data import on_current_data
from hwp_bench.results import Results

#: The badge of a row is the first of these that one of its entries has.
_LEAST = ("differs", "disputed", *(b for b in BADGES if b not in ("differs", "disputed")))


@dataclass(frozen=True)
class BoardRow:
    """One method with one budget and one suite, with an entry for each seed."""

    #: Its entries, the lowest seed first. Not empty.
    entries: tuple[Entry, ...]

    @property
    def first(self) -> Results:
        """The results of the lowest seed."""
        return self.entries[0].results

    @property
    def compared(self) -> list[Results]:
        """The results of every seed, as they are compared with other rows."""
        return [on_current_data(entry.results) for entry in self.entries]

    @property
    def seeds(self) -> tuple[int, ...]:
        """The seeds, rising."""
        return tuple(entry.results.seed for entry in self.entries)

    @property
    def whole(self) -> bool:
        """Whether no capture or test frame of the suite is find_missing."""
        return not find_missing(self.first)

    @property
    def scores(self) -> Mapping[str, float]:
        """Headline scores by metric, means over the seeds."""
        found = [entry.results.scores for entry in self.entries]
        return {name: sum(one[name] for one in found) / len(found) for name in found[0]}

    @property
    def fit_seconds(self) -> float | None:
        """Mean seconds of a fit over captures and seeds; None where the method says none."""
        fits = [
            capture.fit_seconds
            for entry in self.entries
            for capture in entry.results.captures
            if capture.fit_seconds is not None
        ]
        return sum(fits) / len(fits) if fits else None

    @property
    def level(self) -> str:
        """How far every one of its entries was checked, one of `records.LEVELS`."""
        return min((entry.level for entry in self.entries), key=LEVELS.index)

    @property
    def badge(self) -> str:
        """The least that the badge of one of its entries says, one of `records.BADGES`."""
        return min((entry.badge for entry in self.entries), key=_LEAST.index)


@dataclass(frozen=True)
class MethodRow:
    """A method on one suite: the row that stands for it, and all that it had there before."""

    #: Its newest row among those that were checked furthest.
    row: BoardRow
    #: What the board calls it: its title, with who stands for it where a title is there twice.
    label: str
    #: Entries of the method on the suite that are not in the row, the newest first.
    older: tuple[Entry, ...] = ()


def board_rows(entries: Iterable[Entry]) -> list[BoardRow]:
    """Put entries that differ in nothing but the seed together, in the order given.

    Entries of two submitters, or that were checked differently far, are never one row: nobody
    moves a row by another seed of it. An entry that lacks a part of its suite, and a second one of
    the same seed, has a row to itself.

    Args:
        entries: of one suite and one version of the protocol.
    """
    groups: dict[object, list[Entry]] = {}
    for entry in entries:
        key: object = (same_but_seed(entry.results), entry.submission.by, entry.level)
        seeds = {other.results.seed for other in groups.get(key, [])}
        if find_missing(entry.results) or entry.results.seed in seeds:
            key = entry.name
        groups.setdefault(key, []).append(entry)
    return [
        BoardRow(tuple(sorted(group, key=lambda entry: entry.results.seed)))
        for group in groups.values()
    ]


def method_rows(entries: Sequence[Entry]) -> list[MethodRow]:
    """Return one row for each method, in the order in which the methods come.

    The row of a method is whole where one is, checked as far as one is, and of these the newest.

    Args:
        entries: all of one suite and one version of the protocol, those that others revise too.
    """
    methods: dict[object, list[Entry]] = {}
    for entry in entries:
        methods.setdefault(source_of(entry), []).append(entry)
    chosen = [max(board_rows(current(own)), key=_standing) for own in methods.values()]
    return [
        MethodRow(row, label, _older(row, own))
        for row, label, own in zip(chosen, _labels(chosen), methods.values(), strict=True)
    ]


def _standing(row: BoardRow) -> tuple[bool, int, str, str]:
    newest = max(entry.results.started for entry in row.entries)
    return row.whole, LEVELS.index(row.level), newest, row.entries[0].name


def _older(row: BoardRow, own: Iterable[Entry]) -> tuple[Entry, ...]:
    names = {entry.name for entry in row.entries}
    others = [entry for entry in own if entry.name not in names]
    return tuple(sorted(others, key=lambda e: (e.results.started, e.name), reverse=True))


def _labels(rows: Sequence[BoardRow]) -> list[str]:
    """Titles, with the submitter and at last the entry where they do not tell rows apart."""
    titles = [row.first.method.title for row in rows]
    named = [
        f"{title} (by {row.entries[0].submission.by or 'somebody who is not named'})"
        for title, row in zip(titles, rows, strict=True)
    ]
    entries = [f"{title} ({row.entries[0].name})" for title, row in zip(titles, rows, strict=True)]
    labels = []
    for place, title in enumerate(titles):
        texts = ((title, titles), (named[place], named), (entries[place], entries))
        labels.append(next(text for text, all_ in texts if all_.count(text) == 1))
    return labels
