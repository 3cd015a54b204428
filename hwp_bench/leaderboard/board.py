"""The board: a row for each method and suite, over its seeds, ranked with intervals."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

from hwp_bench.analysis.columns import Filled, score_column, table_of
from hwp_bench.analysis.compare import Rank, rank_methods, verdict
from hwp_bench.analysis.pairing import group_runs, same_but_seed, scope_scores
from hwp_bench.base.tables import Column, Table
from hwp_bench.leaderboard.entries import BADGES, LEVELS, Entry
from hwp_bench.leaderboard.rules import HEADLINE, current, source_of, tables_of, takes_over
from hwp_bench.leaderboard.suite_data import Severities, on_current_data, suite_severities
from hwp_bench.metrics import HWP_V1
from hwp_bench.metrics.score import CaptureScores, mean_scores
from hwp_bench.report.study_tables import METRIC
from hwp_bench.results import CaptureResult, Results
from hwp_bench.results.schema import TRAINING_KINDS, budget_text, score_rows
from hwp_bench.suites.suite import find_missing
from hwp_bench.taxonomy import PERTURBATIONS, perturbation

#: The badge of a row is the first of these that one of its entries has.
_WORST = ("contested", "differs", "disputed")
_LEAST = (*_WORST, *(badge for badge in BADGES if badge not in _WORST))


@dataclass(frozen=True)
class BoardRow:
    """One method with one budget and one suite, with an entry for each seed."""

    #: Its entries, the lowest seed first. Not empty.
    entries: tuple[Entry, ...]
    #: What the board calls the method: its title, with who stands for it where two have one title.
    label: str = ""
    #: Entries of the method on the suite that are not in the row, the newest first.
    older: tuple[Entry, ...] = ()

    @property
    def name(self) -> str:
        """Name of its first entry, which stands for the row."""
        return self.entries[0].name

    @property
    def title(self) -> str:
        """The label, or the method's own title."""
        return self.label or self.first.method.title

    @property
    def first(self) -> Results:
        """The results of the lowest seed."""
        return self.entries[0].counted

    @property
    def runs(self) -> list[Results]:
        """The results of every seed, the lowest first: those that the board shows."""
        return [entry.counted for entry in self.entries]

    @property
    def compared(self) -> list[Results]:
        """The results of every seed, as they are compared with other rows."""
        return [on_current_data(one) for one in self.runs]

    @property
    def captures(self) -> list[CaptureResult]:
        """The captures of every seed."""
        return [capture for one in self.runs for capture in one.captures]

    @property
    def seeds(self) -> tuple[int, ...]:
        """The seeds, rising."""
        return tuple(entry.results.seed for entry in self.entries)

    @property
    def suite(self) -> str:
        """Its suite."""
        return self.first.suite

    @property
    def budget(self) -> str:
        """Its budget in words."""
        return budget_text(self.first.budget)

    @property
    def training(self) -> tuple[str, ...]:
        """Kinds of data that it was trained on before, of `TRAINING_KINDS`."""
        return self.first.method.training.kinds

    @property
    def training_text(self) -> str:
        """These kinds in words."""
        return ", ".join(TRAINING_KINDS[kind] for kind in self.training)

    @property
    def date(self) -> str:
        """Day of the latest evaluation, ISO 8601."""
        return max(entry.results.started for entry in self.entries)[:10]

    @property
    def whole(self) -> bool:
        """Whether no capture or test frame of the suite is missing."""
        return not find_missing(self.first)

    @cached_property
    def scores(self) -> Mapping[str, float]:
        """Headline scores by metric, means over the seeds; of metrics that every seed has."""
        return mean_scores(one.scores for one in self.runs)

    @cached_property
    def scopes(self) -> Mapping[str, Mapping[str, float | None]]:
        """Scores by scope and metric, means over seeds; None where the suite has no such capture.

        `motion_blur@3` is the scope of captures whose motion blur is of severity 3.
        """
        found = [_scopes(entry) for entry in self.entries]
        return {
            scope: {name: _mean([one[scope].get(name) for one in found]) for name in HEADLINE}
            for scope in found[0]
        }

    @property
    def fit_seconds(self) -> float | None:
        """Mean seconds of a fit over captures and seeds; None where the method reports none."""
        return _mean([capture.fit_seconds for capture in self.captures])

    @property
    def failed(self) -> int:
        """Frames that failed, over all seeds."""
        return sum(capture.failed_frames for capture in self.captures)

    @property
    def level(self) -> str:
        """How far every one of its entries was checked, one of `LEVELS`."""
        return min((entry.level for entry in self.entries), key=LEVELS.index)

    @property
    def badge(self) -> str:
        """The weakest badge of its entries, one of `BADGES`."""
        return min((entry.badge for entry in self.entries), key=_LEAST.index)

    def why_older(self, entry: Entry) -> str:
        """Say in a few words why one of its older entries is not the row."""
        if withdrawal := entry.withdrawal("entry"):
            return f"withdrawn by {withdrawal.by}: {withdrawal.reason}"
        known = [*self.entries, *self.older]
        for other in known:
            if other.submission.revises == entry.name and takes_over(other, entry):
                return f"replaced: {other.submission.reason}"
        if LEVELS.index(entry.level) < LEVELS.index(self.level):
            return "checked less far than the row"
        return "lacks a part of the suite" if find_missing(entry.results) else "older than the row"


def board_rows(entries: Iterable[Entry]) -> list[BoardRow]:
    """Put entries that differ in nothing but the seed together, in the order given.

    Entries of two submitters, or that were checked differently far, are never one row: nobody
    moves a row by another seed of it. An entry that lacks a part of its suite, and a second one of
    the same seed, has a row to itself.
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


def method_rows(entries: Sequence[Entry]) -> list[BoardRow]:
    """Return one row for each method, in the order in which the methods come.

    A method whose entries were all withdrawn has none. The row of a method is whole where one is,
    checked the furthest, and of these the newest.
    """
    methods: dict[object, list[Entry]] = {}
    for entry in entries:
        methods.setdefault(source_of(entry), []).append(entry)
    methods = {source: own for source, own in methods.items() if current(own)}
    chosen = [max(board_rows(current(own)), key=_standing) for own in methods.values()]
    return [
        replace(row, label=label, older=_older(row, own))
        for row, label, own in zip(chosen, _labels(chosen), methods.values(), strict=True)
    ]


def _standing(row: BoardRow) -> tuple[bool, int, str, str]:
    newest = max(entry.results.started for entry in row.entries)
    return row.whole, LEVELS.index(row.level), newest, row.name


def _older(row: BoardRow, own: Iterable[Entry]) -> tuple[Entry, ...]:
    names = {entry.name for entry in row.entries}
    others = [entry for entry in own if entry.name not in names]
    return tuple(sorted(others, key=lambda e: (e.results.started, e.name), reverse=True))


def _labels(rows: Sequence[BoardRow]) -> list[str]:
    """Titles, with the submitter, and then the entry, where titles are not unique."""
    stages = [
        [row.title for row in rows],
        [
            f"{row.title} (by {row.entries[0].submission.by or 'somebody who is not named'})"
            for row in rows
        ],
        [f"{row.title} ({row.name})" for row in rows],
    ]
    return [
        next(texts[place] for texts in stages if texts.count(texts[place]) == 1)
        for place in range(len(rows))
    ]


def at_severity(
    captures: Sequence[CaptureScores], severities: Severities, level: int
) -> list[CaptureScores]:
    """Return the captures that have a perturbation of one severity, with these perturbations."""
    found = []
    for capture in captures:
        own = severities.get(capture.id, {})
        kept = tuple(name for name in capture.perturbations if own.get(name) == level)
        if kept:
            found.append(replace(capture, perturbations=kept))
    return found


#: Scopes that can be chosen, with their headings.
SCOPES = {
    "macro": "All perturbations (macro mean)",
    "single": "Single hands",
    "interacting": "Interacting hands",
    **{name: perturbation(name).heading for name in PERTURBATIONS},
}
#: Severities that can be chosen.
SEVERITIES = (1, 2, 3, 4, 5)


def _scopes(entry: Entry) -> dict[str, Mapping[str, float]]:
    """Means of the metrics of an entry by scope; an empty one where it has no such capture."""
    captures = score_rows(entry.counted)
    found: dict[str, Mapping[str, float]] = {scope: {} for scope in SCOPES}
    found |= scope_scores(captures)
    severities = suite_severities(entry.results.suite)
    for level in SEVERITIES:
        if chosen := at_severity(captures, severities, level):
            own = scope_scores(chosen)
            found |= {f"{scope}@{level}": means for scope, means in own.items()}
    return found


def severities_of(rows: Sequence[BoardRow]) -> list[int]:
    """Return the severities that captures of the rows have, rising."""
    scopes = {scope for row in rows for scope in row.scopes}
    return [level for level in SEVERITIES if f"macro@{level}" in scopes]


def _mean(values: Sequence[float | None]) -> float | None:
    known = [value for value in values if value is not None]
    return sum(known) / len(known) if known else None


def rankable(rows: Sequence[BoardRow]) -> tuple[list[BoardRow], str]:
    """Choose the rows that can be ranked with each other.

    Ranks come from differences by pairs over the seeds that two rows share. Left out are

    - rows that lack a part of their suite;
    - all rows but one of the same run: the one that was checked furthest stays, then the first by
      name;
    - rows without a seed that others have: rows with the seed that most rows have stay (of several
      the smallest), and of the others those that share a seed with every row that stays.

    Returns:
        Those that stay, in the order given, and a sentence that names the whole rows that do not;
        empty where there are none.
    """
    whole = [row for row in rows if row.whole]
    if not whole:
        return [], ""
    single = _one_of_each_run(whole)
    seeds = sorted({seed for row in single for seed in row.seeds})
    common = max(seeds, key=lambda seed: sum(seed in row.seeds for row in single))
    stay = [row for row in single if common in row.seeds]
    for row in single:
        if row not in stay and all(set(row.seeds) & set(other.seeds) for other in stay):
            stay.append(row)
    parts = []
    if twins := ", ".join(row.name for row in whole if row not in single):
        parts.append(f"No rank for a second entry of the same run: {twins}.")
    if apart := ", ".join(row.name for row in single if row not in stay):
        parts.append(
            f"No rank for rows without the seed {common}, which most rows have, and without a "
            f"seed in common with every other row: {apart}."
        )
    return [row for row in rows if row in stay], " ".join(parts)


def _one_of_each_run(rows: Sequence[BoardRow]) -> list[BoardRow]:
    """Leave out rows that have a run (a state of a method and a seed) of a row before them."""
    seen: set[tuple[str, int]] = set()
    kept = []
    for row in sorted(rows, key=lambda row: (-LEVELS.index(row.level), row.name)):
        runs = {(same_but_seed(row.first), seed) for seed in row.seeds}
        if not runs & seen:
            kept.append(row)
            seen |= runs
    return [row for row in rows if row in kept]


def board_tables(entries: Sequence[Entry]) -> list[Table]:
    """Return a table for each suite and protocol, best row first.

    Each method has one row, of its newest entries that were checked furthest; its older ones are
    left out. A row that lacks a part of its suite is shown without a rank.
    """
    found = tables_of(entries)
    return [_table(suite, protocol, rows) for (suite, protocol), rows in found.items()]


def _table(suite: str, protocol: str, entries: Sequence[Entry]) -> Table:
    rows = method_rows(entries)
    ranks, sentence = ranks_of(rows)

    def place(row: BoardRow) -> tuple[bool, int, float, str]:
        rank = ranks[row.name].rank if row.name in ranks else len(rows)
        return not row.whole, rank, -row.scores[METRIC], row.name

    order = sorted(rows, key=place)
    found = [ranks.get(row.name) for row in order]
    more = [f" and {len(row.seeds) - 1} more" if row.seeds[1:] else "" for row in order]
    columns: list[Filled] = [
        (Column("Method"), [row.title for row in order]),
        (Column("Rank", 0, group="Rank"), [rank.rank if rank else None for rank in found]),
        (Column("95 %", group="Rank"), [rank.interval if rank else None for rank in found]),
        *((score_column(name), [row.scores[name] for row in order]) for name in HEADLINE),
        (Column("Fit [s]", 1), [row.fit_seconds for row in order]),
        (Column("Seeds", 0), [len(row.seeds) for row in order]),
        (Column("Training data"), [row.training_text for row in order]),
        (Column("Level"), [row.level for row in order]),
        (Column("Badge"), [row.badge for row in order]),
        (Column("Entry"), [row.name + text for row, text in zip(order, more, strict=True)]),
    ]
    notes = [sentence] if sentence else []
    lacking = frozenset(place for place, row in enumerate(order) if not row.whole)
    if lacking:
        notes.append("Rows that lack captures or test frames of the suite have no rank.")
    if protocol != HWP_V1.name:
        notes.append(f"Scored by {protocol}; rows of {HWP_V1.name} stand in another table.")
    if older := sum(len(row.older) for row in rows):
        notes.append(f"{older} older or less checked entries of these methods are not shown.")
    return table_of(f"Suite {suite}, protocol {protocol}", columns, notes, unranked=lacking)


def ranks_of(rows: Sequence[BoardRow]) -> tuple[dict[str, Rank], str]:
    """Return ranks by the name of a row, and the sentence that says who wins."""
    ranked, left_out = rankable(rows)
    if not ranked:
        return {}, ""
    compared = {
        row.name: [
            replace(one, method=replace(one.method, title=row.title)) for one in row.compared
        ]
        for row in ranked
    }
    runs = group_runs([one for results in compared.values() for one in results])
    ranking = rank_methods(runs, METRIC)
    by_label = {item.standing.label: item for item in ranking.ranks}
    # What is compared is made again for each row, so that a run tells which row it is of.
    run_of = {id(one): run.label for run in runs for one in run.seeds.values()}
    found = {name: by_label[run_of[id(own[0])]] for name, own in compared.items()}
    budgets = list(dict.fromkeys(row.budget for row in ranked))
    unequal = f"Budgets differ: {'; '.join(budgets)}." if budgets[1:] else ""
    return found, " ".join(filter(None, (verdict(ranking), unequal, left_out)))
