"""Rows of the board: entries that differ in nothing but the seed are one row."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass

from hwp_bench.analysis.statistics.pairing import same_but_seed
from hwp_bench.evaluation.completeness import missing
from hwp_bench.leaderboard.entries import Entry
from hwp_bench.leaderboard.records import BADGES, LEVELS
from hwp_bench.leaderboard.suite_data import on_current_data
from hwp_bench.results import Results

#: The badge of a row is the first of these that one of its entries has.
_LEAST = ("differs", *(badge for badge in BADGES if badge != "differs"))


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
        """Whether no capture or test frame of the suite is missing."""
        return not missing(self.first)

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


def board_rows(entries: Iterable[Entry]) -> list[BoardRow]:
    """Put entries that differ in nothing but the seed together, in the order given.

    An entry that lacks a part of its suite, and a second one of the same seed, has a row to itself.

    Args:
        entries: of one suite and one version of the protocol.
    """
    groups: dict[object, list[Entry]] = {}
    for entry in entries:
        key: object = same_but_seed(entry.results)
        seeds = {other.results.seed for other in groups.get(key, [])}
        if missing(entry.results) or entry.results.seed in seeds:
            key = entry.name
        groups.setdefault(key, []).append(entry)
    return [
        BoardRow(tuple(sorted(group, key=lambda entry: entry.results.seed)))
        for group in groups.values()
    ]
