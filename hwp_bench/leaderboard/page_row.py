"""A row as the board's page shows it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from hwp_bench.evaluation.completeness import missing
from hwp_bench.leaderboard.board_rows import BoardRow
from hwp_bench.leaderboard.entries import Entry
from hwp_bench.leaderboard.records import LEVELS
from hwp_bench.leaderboard.rules import takes_over
from hwp_bench.leaderboard.severity_scopes import at_severity, suite_severities
from hwp_bench.metrics.score import CaptureScores, aggregate
from hwp_bench.results.schema import score_rows
from hwp_bench.taxonomy import PERTURBATIONS, perturbation

#: Metrics of the board.
METRICS = ("psnr", "ssim", "oriented_distance")
#: Scopes that can be chosen, with their headings.
SCOPES = {
    "macro": "All perturbations (macro mean)",
    "single": "Single hands",
    "interacting": "Interacting hands",
    **{name: perturbation(name).heading for name in PERTURBATIONS},
}
#: Severities that can be chosen.
SEVERITIES = (1, 2, 3, 4, 5)


@dataclass(frozen=True)
class OlderRun:
    """An entry of a method that does not stand for it any more, or not yet."""

    #: Name of the entry.
    name: str
    #: Day of the evaluation, ISO 8601.
    date: str
    #: Its budget in words.
    budget: str
    #: The seed.
    seed: int
    #: PSNR, macro mean, dB.
    psnr: float
    #: How far it was checked, one of `records.LEVELS`.
    level: str
    #: Why it is not the row, in a few words.
    why: str


@dataclass(frozen=True)
class Row:
    """One measured row: a method with one budget on one suite, over its seeds."""

    #: Name of its first entry, which stands for the row.
    name: str
    #: What the board calls the method.
    title: str
    #: Its suite.
    suite: str
    #: Its budget in words.
    budget: str
    #: Device that the method says it ran on.
    device: str
    #: Names of its entries by seed, the lowest first.
    seeds: Mapping[int, str]
    #: Day of the latest evaluation, ISO 8601.
    date: str
    #: Scores by scope and metric, means over seeds; None where the suite has no such capture.
    #: `motion_blur@3` is the scope of captures whose motion blur is of severity 3.
    scores: Mapping[str, Mapping[str, float | None]]
    #: Mean seconds of a fit.
    fit: float | None
    #: Frames that failed, over all seeds.
    failed: int
    #: How far all of it was checked, one of `records.LEVELS`.
    level: str
    #: Its reproducibility badge, one of `records.BADGES`.
    badge: str
    #: What the method had on the suite before, the newest first.
    older: Sequence[OlderRun] = ()


def make_row(row: BoardRow, label: str = "", older: Sequence[Entry] = ()) -> Row:
    """Return a row as the page shows it.

    Args:
        row: the row.
        label: what the board calls the method; empty takes its title.
        older: other entries of the method on the suite.
    """
    found = [_scopes(entry) for entry in row.entries]
    captures = [capture for entry in row.entries for capture in entry.results.captures]
    return Row(
        name=row.entries[0].name,
        title=label or row.first.method.title,
        suite=row.first.suite,
        budget=budget_text(row.first.budget),
        device=", ".join(sorted({one.device for one in captures if one.device})) or "not said",
        seeds={entry.results.seed: entry.name for entry in row.entries},
        date=max(entry.results.started for entry in row.entries)[:10],
        scores={
            scope: {name: _mean([one[scope].get(name) for one in found]) for name in METRICS}
            for scope in found[0]
        },
        fit=row.fit_seconds,
        failed=sum(capture.failed_frames for capture in captures),
        level=row.level,
        badge=row.badge,
        older=[_older_run(entry, row, older) for entry in older],
    )


def _older_run(entry: Entry, row: BoardRow, older: Sequence[Entry]) -> OlderRun:
    known = [*row.entries, *older]
    corrections = [e for e in known if e.submission.revises == entry.name and takes_over(e, entry)]
    if corrections:
        why = f"replaced: {corrections[0].submission.reason}"
    elif LEVELS.index(entry.level) < LEVELS.index(row.level):
        why = "checked less far than the row"
    elif missing(entry.results):
        why = "lacks a part of the suite"
    else:
        why = "older than the row"
    results = entry.results
    return OlderRun(
        name=entry.name,
        date=results.started[:10],
        budget=budget_text(results.budget),
        seed=results.seed,
        psnr=results.scores["psnr"],
        level=entry.level,
        why=why,
    )


def _scopes(entry: Entry) -> dict[str, Mapping[str, float]]:
    """Means of the metrics of an entry by scope; an empty one where it has no such capture."""
    captures = score_rows(entry.results)
    found = _means(captures)
    severities = suite_severities(entry.results.suite)
    for level in SEVERITIES:
        if chosen := at_severity(captures, severities, level):
            found |= {f"{scope}@{level}": means for scope, means in _means(chosen).items() if means}
    return found


def _means(captures: Sequence[CaptureScores]) -> dict[str, Mapping[str, float]]:
    mean = aggregate(captures)
    return {
        **{scope: {} for scope in SCOPES},
        "macro": mean.overall.macro,
        "single": mean.single.capture_mean if mean.single else {},
        "interacting": mean.interacting.capture_mean if mean.interacting else {},
        **mean.overall.perturbations,
    }


def severities_of(rows: Sequence[Row]) -> list[int]:
    """Return the severities that captures of the rows have, rising."""
    scopes = {scope for row in rows for scope in row.scores}
    return [level for level in SEVERITIES if f"macro@{level}" in scopes]


def _mean(values: Sequence[float | None]) -> float | None:
    known = [value for value in values if value is not None]
    return sum(known) / len(known) if known else None


def budget_text(budget: Mapping[str, Any]) -> str:
    """Return a budget in words: `60 s`, `500 steps`, `60 s, 500 steps` or `no limit`."""
    units = {"seconds": "s", "steps": "steps"}
    parts = [f"{budget[name]:g} {unit}" for name, unit in units.items() if budget.get(name)]
    return ", ".join(parts) or "no limit"
